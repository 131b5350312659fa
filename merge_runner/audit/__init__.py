"""Checks that what is stored is what was asked, answered and driven, and each sample only once."""

from __future__ import annotations

from merge_runner.audit.derived import NOT_DERIVED
from merge_runner.audit.findings import Audit, Finding, Sharing
from merge_runner.audit.folder import audit_cache
from merge_runner.audit.recordings import audit_recording
from merge_runner.audit.sweeps import audit_database, audit_sweep

__all__ = [
    "NOT_DERIVED",
    "Audit",
    "Finding",
    "Sharing",
    "audit_cache",
    "audit_database",
    "audit_recording",
    "audit_sweep",
]
