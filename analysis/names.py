"""Names that stand in results, here without an import, so that light modules can have them too."""

HUMAN = "human"
BASELINE = "baseline"
