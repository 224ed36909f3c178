"""The catalogue: which trips there are, where their logs stand, and what was computed of them."""

from typing import TYPE_CHECKING

from trainlog.extras import names_on_first_use, require

require("sqlalchemy", "sqlglot")

if TYPE_CHECKING:
    from trainlog.catalogue.catalogue import (
        Catalogue as Catalogue,
        open_catalogue as open_catalogue,
        write_trips as write_trips,
    )
    from trainlog.catalogue.database import TRIP_COLUMNS as TRIP_COLUMNS, TripColumn as TripColumn
    from trainlog.catalogue.registration import (
        Added as Added,
        FileEntry as FileEntry,
        FileOutcome as FileOutcome,
        LogEntry as LogEntry,
        Refreshed as Refreshed,
        read_entry as read_entry,
        read_file as read_file,
    )
    from trainlog.catalogue.results import (
        Computation as Computation,
        ResultOutcome as ResultOutcome,
    )

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
