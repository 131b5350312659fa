"""Calibration of the thresholds of the driver ``cei``; README.md has the results."""
