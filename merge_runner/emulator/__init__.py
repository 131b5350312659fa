"""A local language model server with a scripted driver behind it: a stand-in, not a model."""
