"""The tables of a catalogue.

Times are nanoseconds since 1970 UTC; numbers are in SI units, but kilometres, which are those that
stand along the line. `trainlog.catalogue.migration` brings tables of earlier versions to these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import sqlalchemy as sa

Kind = Literal["text", "time", "number", "count", "json"]


@dataclass(frozen=True, slots=True)
class TripColumn:
    """What is asked of trips: a column of the frame of trips, and a word of an expression.

    Attributes
    ----------
    name : str
    kind : {"text", "time", "number", "count", "json"}
    unit : str
        In which the frame holds it; an expression states the unit with the number.
    meaning : str
    """

    name: str
    kind: Kind
    unit: str
    meaning: str


TRIP_COLUMNS: tuple[TripColumn, ...] = (
    TripColumn("key", "text", "", "digest of what was recorded: the same for all files of a trip"),
    TripColumn("name", "text", "", "of the trip"),
    TripColumn("train", "text", "", "that drove"),
    TripColumn("kind", "text", "", "of the train"),
    TripColumn("line", "text", "", "that it drove on; of a route also the lines it ran over"),
    TripColumn("direction", "text", "", "forward or reverse"),
    TripColumn("start", "time", "", "of the first message, UTC"),
    TripColumn("end", "time", "", "of the last message, UTC"),
    TripColumn("duration", "number", "s", "from the first to the last message"),
    TripColumn("distance", "number", "m", "between the ends of the stretch driven"),
    TripColumn("km_from", "number", "km", "least kilometre of the stretch driven"),
    TripColumn("km_to", "number", "km", "greatest"),
    TripColumn("weather", "text", "", "condition of the rail that the log states"),
    TripColumn("load", "number", "kg", "that the log states"),
    TripColumn("labels", "json", "", "all other facts that the log states"),
    TripColumn("topics", "json", "", "messages of each topic"),
    TripColumn("passport", "json", "", "value of each quantity of the passport"),
    TripColumn("quality", "text", "", "whole, unclosed or damaged"),
    TripColumn("damage", "text", "", "what of the log is lost; empty if nothing is"),
    TripColumn("repairs", "count", "", "that ingesting the recording took"),
    TripColumn("samples", "count", "", "values of the column that identifies the drive"),
    TripColumn("messages", "count", "", "of all topics"),
    TripColumn("software", "text", "", "that made the log"),
    TripColumn("added", "time", "", "when it came into the catalogue, UTC"),
    TripColumn("sha256", "text", "", "of the log"),
)
"""What the catalogue knows of a trip."""

_JSON = sa.JSON(none_as_null=True)
_TEXT = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")
_TYPES: dict[Kind, Any] = {
    "text": _TEXT,
    "time": sa.BigInteger,
    "number": sa.Double,
    "count": sa.BigInteger,
    "json": _JSON,
}
_ID = sa.BigInteger().with_variant(sa.Integer, "sqlite")

metadata = sa.MetaData()

header = sa.Table(
    "header",
    metadata,
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("value", sa.Text, nullable=False),
)

trips = sa.Table(
    "trips",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    *(
        sa.Column(each.name, _TYPES[each.kind], nullable=each.name not in ("key", "sha256"))
        for each in TRIP_COLUMNS
    ),
    sa.Column("source", sa.Text, nullable=False),
    sa.Column("blocks", sa.LargeBinary, nullable=False),
    sa.Column("standing", sa.Text, nullable=False),
    sa.Column("same_as", _ID),
    sa.Column("share", sa.Double),
    sa.Index("trips_by_content", "sha256", unique=True),
    sa.Index("trips_counting", "key", "standing", "sha256", "id"),
    sa.Index(
        "trips_apart",
        "id",
        sqlite_where=sa.text("standing <> 'counts'"),
        postgresql_where=sa.text("standing <> 'counts'"),
    ),
    sa.Index("trips_by_time", "start", "end"),
    sa.Index("trips_by_train", "train", "start"),
    sa.Index("trips_by_line", "line", "start"),
    sa.Index("trips_by_duration", "duration"),
)
"""One row a log by content. `standing`: ``"counts"``, ``"same drive"`` (another recording of the
drive is fuller, `same_as`, with which it shares `share` of the shorter one) or ``"older version"``
(what stood under the file's name before)."""

files = sa.Table(
    "files",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("path", _TEXT, nullable=False),
    sa.Column("sha256", _TEXT, nullable=False),
    sa.Column("size", sa.BigInteger),
    sa.Column("changed", sa.BigInteger),
    sa.Column("trip", _ID, sa.ForeignKey("trips.id")),
    sa.Column("state", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.UniqueConstraint("path", "sha256"),
    sa.Index("files_by_trip", "trip", "state", "path"),
    sa.Index("files_by_content", "sha256"),
    sa.Index("files_by_state", "state"),
)
"""One row a file and content. `state`: ``"present"``, ``"vanished"``, ``"moved"``, ``"replaced"``
(another content stands under its name) or ``"refused"`` (`reason`)."""

trip_edges = sa.Table(
    "trip_edges",
    metadata,
    sa.Column("trip", _ID, sa.ForeignKey("trips.id"), primary_key=True),
    sa.Column("place", sa.Integer, primary_key=True),
    sa.Column("edge", _TEXT, nullable=False),
    sa.Column("km_from", sa.Double),
    sa.Column("km_to", sa.Double),
    sa.Column("direction", sa.Text, nullable=False),
    sa.Index("trip_edges_by_edge", "edge", "trip"),
)
"""The lines that a trip ran over, in its order: those of its route, or its line."""

computations = sa.Table(
    "computations",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("analysis", _TEXT, nullable=False),
    sa.Column("code", _TEXT, nullable=False),
    sa.Column("parameters", _TEXT, nullable=False),
    sa.Column("content", sa.Text, nullable=False),
    sa.Column("last", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("analysis", "code", "parameters"),
)
"""What was computed: an analysis, the version of its code, the digest of its parameters and these
as JSON; `last` counts what was recorded, so that the latest is known."""

result_files = sa.Table(
    "result_files",
    metadata,
    sa.Column("id", _ID, primary_key=True),
    sa.Column("computation", _ID, sa.ForeignKey("computations.id"), nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("rows", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("computation", "name"),
)

results = sa.Table(
    "results",
    metadata,
    sa.Column("computation", _ID, sa.ForeignKey("computations.id"), primary_key=True),
    sa.Column("trip", _ID, sa.ForeignKey("trips.id"), primary_key=True),
    sa.Column("state", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("file", _ID, sa.ForeignKey("result_files.id")),
    sa.Column("rows", sa.BigInteger, nullable=False),
    sa.Column("seconds", sa.Double),
    sa.Index("results_by_file", "file"),
)
"""One row a log, analysis, code and parameters: ``"done"``, ``"refused"`` or ``"failed"``."""


def log_of_trip() -> Any:
    """The path of the log of a trip, of several copies that of the first that was registered."""
    asked = sa.select(files.c.path).where(files.c.trip == trips.c.id, files.c.state == "present")
    return asked.order_by(files.c.id).limit(1).correlate(trips).scalar_subquery().label("path")


def on_line(
    condition: sa.ColumnElement[bool], over: sa.ColumnElement[bool], few: bool = False
) -> Any:
    """Whether a trip is of a line, or ran over one, by a condition on its name and on an edge's.

    Where what else is asked leaves `few` trips, the edges of each are looked at; else the trips of
    the edge are found first.
    """
    if few:
        edge = sa.exists().where(trip_edges.c.trip == trips.c.id, over).correlate(trips)
        return sa.or_(condition, edge)
    return sa.or_(condition, trips.c.id.in_(sa.select(trip_edges.c.trip).where(over)))
