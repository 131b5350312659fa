"""Stored results: database, recordings and provenance."""
