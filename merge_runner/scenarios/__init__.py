"""The driving task: the simplified merge."""
