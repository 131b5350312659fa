"""The emulator as test equipment: with every fault of a provider, and three batch modes."""

from tests.support.mock_server.emulator import FaultyEmulator, application, serve, served
from tests.support.mock_server.plans import (
    FAULTS,
    TRANSIENT,
    BatchPlan,
    FaultPlan,
    transient_faults,
)

__all__ = [
    "FAULTS",
    "TRANSIENT",
    "BatchPlan",
    "FaultPlan",
    "FaultyEmulator",
    "application",
    "serve",
    "served",
    "transient_faults",
]
