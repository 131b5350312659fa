"""The pictures: their numbers, what they have in common, and how each is drawn."""
