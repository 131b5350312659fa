"""The driver ``cei``: the communication-enabled interaction model of human merging.

Siebinga, Zgonnikov and Abbink, PNAS Nexus 3(10), pgae420 (2024), arXiv 2312.09776; re-implemented
from its equations, with thresholds calibrated to its published outcomes.
"""

from merge_runner.drivers.cei.driver import CeiDriver

__all__ = ["CeiDriver"]
