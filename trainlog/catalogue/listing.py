"""What a catalogue holds as a whole: counts, trains and lines, and files that do not count."""

from __future__ import annotations

from typing import Any

import pandas as pd
import sqlalchemy as sa

from trainlog.catalogue.database import Database, columns_of
from trainlog.catalogue.schema import files, trip_edges, trips
from trainlog.errors import InputError


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
    earliest = (
        sa.select(sa.func.min(files.c.id)).where(files.c.state == "present").group_by(files.c.trip)
    )
    first = sa.select(files.c.trip, files.c.path).where(files.c.id.in_(earliest)).subquery()
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


GROUPS: dict[str, tuple[str, ...]] = {
    "route": ("train", "kind", "line"),
    "train": ("train",),
    "kind": ("kind",),
    "line": ("line",),
    "weather": ("weather",),
    "edge": ("edge",),
    "day": ("day",),
}
"""By what an overview can be, and the columns that name a row of it."""

_DAY = 86_400_000_000_000


def overview(database: Database, by: str) -> pd.DataFrame:
    """How many trips there are by train, line, edge or day; see `Catalogue.overview`."""
    if by not in GROUPS:
        raise InputError(f"there is no overview by '{by}'", remedy=f"known: {', '.join(GROUPS)}")
    names = GROUPS[by]
    edge = trip_edges.c
    columns: dict[str, Any] = {name: trips.c[name] for name in names if name in trips.c}
    columns |= {"edge": edge.edge} if by == "edge" else {}
    columns |= {"day": trips.c.start // _DAY} if by == "day" else {}
    count, total = sa.func.count, sa.func.sum
    # Of a train some logs may not state the kind.
    sums: dict[str, Any] = {"kind": sa.func.max(trips.c.kind)} if by == "train" else {}
    sums["trips"] = count(trips.c.id.distinct())
    if "train" not in names:
        sums["trains"] = count(trips.c.train.distinct())
    if not {"line", "edge"} & set(names):
        sums["lines"] = count(trips.c.line.distinct())
    if by != "day":
        sums |= {"first": sa.func.min(trips.c.start), "last": sa.func.max(trips.c.start)}
    asked = sa.select(trips.c.id)
    if by == "edge":
        asked = asked.join(trip_edges, edge.trip == trips.c.id)
        sums["forward"] = total(sa.case((edge.direction == "forward", 1), else_=0))
        sums["reverse"] = total(sa.case((edge.direction == "reverse", 1), else_=0))
        sums["distance"] = 1e3 * total(edge.km_to - edge.km_from)
    else:
        sums |= {"distance": total(trips.c.distance), "duration": total(trips.c.duration)}
        sums["damaged"] = total(sa.case((trips.c.quality == "damaged", 1), else_=0))
    asked = asked.with_only_columns(*columns.values(), *sums.values(), maintain_column_froms=True)
    asked = asked.where(trips.c.standing == "counts").group_by(*columns.values())
    with database.reading() as connection:
        rows = connection.execute(asked).all()
    frame = pd.DataFrame(columns_of(rows, [*columns, *sums]))
    for name in {"first", "last"} & set(frame):
        frame[name] = pd.to_datetime(frame[name].astype("Int64"), unit="ns", utc=True)
    for name in {"distance", "duration"} & set(frame):
        frame[name] = frame[name].astype("float64")
    for name in {"damaged", "forward", "reverse"} & set(frame):
        frame[name] = frame[name].astype("int64")
    if by == "day":
        days = pd.to_datetime(frame["day"].astype("Int64") * _DAY, unit="ns", utc=True)
        frame["day"] = days.dt.strftime("%Y-%m-%d").astype(object)
    order = frame[list(names)].fillna("").sort_values(list(names))
    return frame.loc[order.index].reset_index(drop=True)
