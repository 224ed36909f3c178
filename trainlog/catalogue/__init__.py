"""The catalogue: which trips there are, where their logs stand, and what was computed of them."""

# The extra is checked before the modules that import it.
# ruff: noqa: E402

from trainlog.extras import require

require("sqlalchemy", "sqlglot", "duckdb")

from trainlog.catalogue.catalogue import Catalogue, Refreshed, open_catalogue
from trainlog.catalogue.export import write_trips
from trainlog.catalogue.reading import FileEntry, LogEntry, read_entry, read_file
from trainlog.catalogue.registration import Added, FileOutcome
from trainlog.catalogue.results import ResultOutcome
from trainlog.catalogue.schema import TRIP_COLUMNS, TripColumn

__all__ = [
    "TRIP_COLUMNS",
    "Added",
    "Catalogue",
    "FileEntry",
    "FileOutcome",
    "LogEntry",
    "Refreshed",
    "ResultOutcome",
    "TripColumn",
    "open_catalogue",
    "read_entry",
    "read_file",
    "write_trips",
]
