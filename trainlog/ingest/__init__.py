"""Recorded formats become trips: read by a registered format, repaired by stated rules.

Examples
--------
>>> from trainlog.ingest import ingest, report_of
>>> report_of(ingest("sample_logs/gnss.csv")).lines()[0]
'6847 rows read, 6847 kept, 0 dropped'
"""

from trainlog.ingest.batch import Ingested, Outcome, ingest_all
from trainlog.ingest.pipeline import PROFILE_ATTACHMENT, ingest, ingest_each
from trainlog.ingest.profile import Profile, profile_of, read_profile
from trainlog.ingest.proposal import Proposal, needs_profile, propose_profile
from trainlog.ingest.recording import NO_TIME, Finding, Raw, Recording, Table
from trainlog.ingest.registry import Format, formats
from trainlog.ingest.report import REPAIRS_ATTACHMENT, Report, repairs_of, report_of
from trainlog.ingest.rules import RULES, Rule

__all__ = [
    "NO_TIME",
    "PROFILE_ATTACHMENT",
    "REPAIRS_ATTACHMENT",
    "RULES",
    "Finding",
    "Format",
    "Ingested",
    "Outcome",
    "Profile",
    "Proposal",
    "Raw",
    "Recording",
    "Report",
    "Rule",
    "Table",
    "formats",
    "ingest",
    "ingest_all",
    "ingest_each",
    "needs_profile",
    "profile_of",
    "propose_profile",
    "read_profile",
    "repairs_of",
    "report_of",
]
