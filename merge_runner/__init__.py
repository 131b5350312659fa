"""Finds out whether a language model drives like a human."""

__all__ = ["__version__"]

__version__ = "0.1.0"
