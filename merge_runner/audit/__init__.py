"""Checks that what is stored is what was asked, answered and driven, and each sample only once."""
