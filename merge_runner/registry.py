"""What may vary, each kind in one table that packages from outside can add to.

An installed package that names a module under the entry point group ``merge_runner`` has it
imported before the first look into any table; what it registers is then as good as built in:

    [project.entry-points.merge_runner]
    anything = "my_package.my_drivers"
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, TypeVar

from merge_runner.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "merge_runner"
T = TypeVar("T")


class Registry(Mapping[str, T]):
    """The things of one kind by name, in the order in which they were registered."""

    def __init__(self, kind: str) -> None:
        """``kind`` is what one of them is called in messages."""
        self.kind = kind
        self._things: dict[str, T] = {}

    def register(self, name: str, thing: T) -> T:
        """Add a thing, and return it; raises UsageError where the name is taken."""
        if name in self._things:
            raise UsageError(f"there is a {self.kind} {name!r} already")
        self._things[name] = thing
        return thing

    def require(self, name: str, hint: str = "") -> T:
        """The thing of this name; raises UsageError, which lists those that there are."""
        if name not in self:
            valid = ", ".join(self) + (f" ({hint})" if hint else "")
            raise UsageError(f"unknown {self.kind} {name!r}; valid: {valid}")
        return self[name]

    def __getitem__(self, name: str) -> T:
        """The thing of this name; raises KeyError."""
        load_plugins()
        return self._things[name]

    def __iter__(self) -> Iterator[str]:
        """All names."""
        load_plugins()
        return iter(self._things)

    def __len__(self) -> int:
        """How many there are."""
        load_plugins()
        return len(self._things)


_loaded: set[str] = set()


def plugins() -> list[EntryPoint]:
    """What installed packages name, in the order in which it is imported."""
    from importlib.metadata import entry_points

    return sorted(entry_points(group=GROUP), key=lambda point: (point.value, point.name))


def load_plugins() -> None:
    """Import what installed packages register, once; raises UsageError where that fails."""
    if GROUP in _loaded:
        return
    _loaded.add(GROUP)  # before, since a plug-in may look into a table while it is imported
    for point in plugins():
        try:
            point.load()
        except (ImportError, AttributeError, SyntaxError) as exc:
            raise UsageError(f"the plug-in {point.name} = {point.value!r} fails: {exc}") from exc
