"""What a catalogue holds as a whole: counts, trains and lines, and files that do not count."""

from __future__ import annotations

import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue.database import Database
from trainlog.catalogue.schema import files, trips


def counts(database: Database) -> dict[str, int]:
    """How many trips and files there are by what became of them; see `Catalogue.counts`."""
    count = sa.func.count()
    with database.reading() as connection:
        standing = connection.execute(sa.select(trips.c.standing, count).group_by(trips.c.standing))
        states = connection.execute(sa.select(files.c.state, count).group_by(files.c.state))
        trips_by = {row[0]: int(row[1]) for row in standing}
        files_by = {row[0]: int(row[1]) for row in states}
    return {
        "trips": trips_by.get("counts", 0),
        "other recordings": trips_by.get("same drive", 0),
        "older versions": trips_by.get("older version", 0),
        "files": files_by.get("present", 0),
        "vanished": files_by.get("vanished", 0),
        "refused": files_by.get("refused", 0),
    }


def uncounted(database: Database) -> pd.DataFrame:
    """What does not count, and why; see `Catalogue.uncounted`."""
    other = trips.alias("other")
    standing = (
        sa.select(files.c.path, trips.c.standing, other.c.name, trips.c.share, other.c.key)
        .select_from(trips)
        .join(files, files.c.trip == trips.c.id)
        .join(other, other.c.id == trips.c.same_as)
        .where(files.c.state == "present", trips.c.standing != "counts")
    )
    state = sa.select(files.c.path, files.c.state, files.c.reason).where(
        files.c.state.in_(("vanished", "refused"))
    )
    first = (
        sa.select(files.c.trip, sa.func.min(files.c.path).label("path"))
        .where(files.c.state == "present")
        .group_by(files.c.trip)
        .subquery()
    )
    copies = sa.select(files.c.path, first.c.path).where(
        files.c.trip == first.c.trip, files.c.state == "present", files.c.path != first.c.path
    )
    with database.reading() as connection:
        found = [
            (path, what, f"{'' if share is None else f'{share:.0%} in '}'{name}' ({key[:8]})")
            for path, what, name, share, key in connection.execute(standing)
        ]
        found += [(path, what, reason) for path, what, reason in connection.execute(state)]
        known = {path for path, *_ in found}
        found += [
            (path, "copy", f"the same as {other}")
            for path, other in connection.execute(copies)
            if path not in known
        ]
    return pd.DataFrame(sorted(found), columns=["path", "what", "reason"])


def overview(database: Database) -> pd.DataFrame:
    """One row a train and line, of the trips that count; see `Catalogue.overview`."""
    by = (trips.c.train, trips.c.kind, trips.c.line)
    asked = (
        sa.select(
            *by,
            sa.func.count(),
            sa.func.min(trips.c.start),
            sa.func.max(trips.c.start),
            sa.func.sum(trips.c.distance),
            sa.func.sum(trips.c.duration),
        )
        .where(trips.c.standing == "counts")
        .group_by(*by)
    )
    names = ["train", "kind", "line", "trips", "first", "last", "distance", "duration"]
    with database.reading() as connection:
        frame = pd.DataFrame(connection.execute(asked).all(), columns=names)
    for name in ("first", "last"):
        frame[name] = pd.to_datetime(frame[name].astype("Int64"), unit="ns", utc=True)
    order = frame[["train", "kind", "line"]].fillna("")
    return frame.loc[order.sort_values(["train", "kind", "line"]).index].reset_index(drop=True)
