"""How the thresholds of the model of human merging are found; see README.md."""
