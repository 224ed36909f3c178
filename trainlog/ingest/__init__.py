"""Recorded formats become trips: read by a registered format, repaired by stated rules.

Examples
--------
>>> from trainlog.ingest import ingest, report_of
>>> report_of(ingest("sample_logs/gnss.csv")).lines()[0]
'6847 rows read, 6847 kept, 0 dropped'
"""

from typing import TYPE_CHECKING

from trainlog.extras import names_on_first_use

if TYPE_CHECKING:
    from trainlog.ingest.batch import (
        Ingested as Ingested,
        Outcome as Outcome,
        ingest_all as ingest_all,
    )
    from trainlog.ingest.pipeline import (
        PROFILE_ATTACHMENT as PROFILE_ATTACHMENT,
        ingest as ingest,
        ingest_each as ingest_each,
    )
    from trainlog.ingest.profile import (
        Profile as Profile,
        profile_of as profile_of,
        read_profile as read_profile,
    )
    from trainlog.ingest.proposal import (
        Proposal as Proposal,
        needs_profile as needs_profile,
        propose_profile as propose_profile,
    )
    from trainlog.ingest.recording import (
        NO_TIME as NO_TIME,
        REPAIRS_ATTACHMENT as REPAIRS_ATTACHMENT,
        Finding as Finding,
        Raw as Raw,
        Recording as Recording,
        Report as Report,
        Table as Table,
        repairs_of as repairs_of,
        report_of as report_of,
    )
    from trainlog.ingest.registry import Format as Format, formats as formats
    from trainlog.ingest.rules import RULES as RULES, Rule as Rule

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
