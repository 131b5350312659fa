"""Results at rest: the database, recordings, and what is known of how they were made."""
