"""Code that was run once, or is run before a release; not in the wheel."""
