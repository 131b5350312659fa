"""Prompts from observations, and validated plans from replies."""
