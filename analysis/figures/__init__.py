"""The figures: the numbers in them, what they have in common, and how each is drawn."""
