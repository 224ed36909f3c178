"""Profiles proposed for tables of an unknown layout."""

from trainlog.ingest.proposal.layout import Reading
from trainlog.ingest.proposal.proposal import Proposal, needs_profile, propose_profile

__all__ = ["Proposal", "Reading", "needs_profile", "propose_profile"]
