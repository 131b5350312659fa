"""A sweep under way: what is to be played, who plays it, and what is shown of it."""
