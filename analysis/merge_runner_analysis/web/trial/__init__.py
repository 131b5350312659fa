"""One trial: reading, cause of its outcome, and the data of its page."""
