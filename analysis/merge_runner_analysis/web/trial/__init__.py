"""One trial: how it is read, why it went so, and what its page draws."""
