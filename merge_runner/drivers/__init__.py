"""Whoever decides how a vehicle accelerates: a language model or a plain program."""

# The registry comes first, so that its order does not depend on which driver is imported first.
from merge_runner.drivers import registry as registry
