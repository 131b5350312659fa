"""The communication-enabled interaction model of human merging, as a program that drives.

Siebinga, Zgonnikov and Abbink, PNAS Nexus 3(10), pgae420 (2024), arXiv 2312.09776; re-implemented
from its equations, with thresholds calibrated to its published outcomes.
"""

from merge_runner.drivers.cei import driver as driver  # registers the program
