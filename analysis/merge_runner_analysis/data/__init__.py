"""What is analysed: the groups of a database, imported humans, and shipped reference values."""
