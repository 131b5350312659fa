"""The emulator as test equipment: with every fault of a provider, and three batch modes."""

from tests.support.mock_server.emulator import application, serve, served
from tests.support.mock_server.faults import TRANSIENT, BatchPlan, FaultPlan

__all__ = ["TRANSIENT", "BatchPlan", "FaultPlan", "application", "serve", "served"]
