"""Whoever decides how a vehicle accelerates: a language model or a plain program."""
