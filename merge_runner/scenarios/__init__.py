"""The driving tasks: what a scenario is, and one folder for each."""
