"""From an observation to the prompt, and from a reply's text to a validated plan."""
