"""The human recordings of the simplified merge (4TU doi 10.4121/19550377)."""
