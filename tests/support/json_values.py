"""JSON values with one value in them changed."""

from copy import deepcopy


def paths(value, path=()):
    """The paths to all values inside a JSON value."""
    if isinstance(value, dict | list):
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield (*path, name)
            yield from paths(inner, (*path, name))


def replaced(value, path, *by):
    """A copy in which another value stands at a path, or none where none is given."""
    copy = inner = deepcopy(value)
    for name in path[:-1]:
        inner = inner[name]
    if by:
        (inner[path[-1]],) = by
    else:
        del inner[path[-1]]
    return copy
