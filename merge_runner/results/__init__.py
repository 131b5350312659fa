"""Results at rest: the database, recordings, and where they come from."""
