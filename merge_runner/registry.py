"""What may vary, each kind in one table that packages from outside can add to.

An installed package that names a module under the entry point group ``merge_runner`` has it
imported before the first look into any table; what it registers is then as good as built in:

    [project.entry-points.merge_runner]
    anything = "my_package.my_drivers"
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from merge_runner.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "merge_runner"
# What can stand in a trial's id, on the command line and in an address.
NAME = re.compile(r"[A-Za-z0-9_.-]+")
T = TypeVar("T")
_registries: list[Registry[Any]] = []
# Who registers now: the program and what is installed, or a part of a study.
_owner = [""]
_changes = [0]


def unregister(owner: str) -> None:
    """Take out all that an owner has registered."""
    for registry in _registries:
        registry.drop(owner)
    _changes[0] += 1


@contextmanager
def registering(owner: str) -> Iterator[None]:
    """What is registered meanwhile takes the place of all that the same owner had registered."""
    unregister(owner)
    _owner.append(owner)
    try:
        yield
    finally:
        _owner.pop()


def changes() -> int:
    """How often something was registered anew; what is derived from a registry holds until then."""
    return _changes[0]


def require(things: Mapping[str, T], kind: str, name: str, hint: str = "") -> T:
    """The thing of this name; raises UsageError."""
    if name not in things:
        raise unknown_name(kind, name, things, hint)
    return things[name]


class Registry(Mapping[str, T]):
    """The things of one kind by name, in the order in which they were registered."""

    def __init__(self, kind: str) -> None:
        """``kind`` is what one of them is called in messages."""
        self.kind = kind
        self._things: dict[str, T] = {}
        self._owners: dict[str, str] = {}
        _registries.append(self)

    def register(self, name: str, thing: T) -> T:
        """Add a thing, and return it; raises UsageError where the name is taken or odd."""
        if not NAME.fullmatch(name):
            raise UsageError(f"the {self.kind} {name!r} needs a name of letters, digits, _ - and .")
        if name in self._things:
            raise UsageError(f"there is a {self.kind} {name!r} already")
        self._things[name] = thing
        self._owners[name] = _owner[-1]
        return thing

    def replace(self, name: str, thing: T) -> T:
        """Like ``register``, but in place of what was registered here by ``replace`` before."""
        with registering(f"{self.kind} {name}"):
            return self.register(name, thing)

    def drop(self, owner: str) -> None:
        """Take out what an owner has registered."""
        for name in [name for name, theirs in self._owners.items() if theirs == owner]:
            del self._things[name], self._owners[name]

    def require(self, name: str, hint: str = "") -> T:
        """See ``require``."""
        return require(self, self.kind, name, hint)

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


_study_texts: list[str] = []


def study_texts() -> Sequence[str]:
    """The file of the study that is adopted and the sources of its plug-ins; empty without one."""
    return _study_texts


def note_study(texts: Iterable[str]) -> None:
    """Keep the texts of the study that is adopted now."""
    _study_texts[:] = texts


# What the code of somebody else may raise while it is imported.
FAULTS = (ArithmeticError, AttributeError, ImportError, LookupError, NameError, OSError,
          RuntimeError, SyntaxError, TypeError, ValueError)  # fmt: skip
_loaded: set[str] = set()


def plugins() -> list[EntryPoint]:
    """What installed packages name, in the order in which it is imported."""
    from importlib.metadata import entry_points

    return sorted(entry_points(group=GROUP), key=lambda point: (point.value, point.name))


def plugin_sources() -> Iterator[Path]:
    """The folder of each package that a plug-in is a part of, or the file of its module."""
    for name in dict.fromkeys(point.module.partition(".")[0] for point in plugins()):
        found = find_spec(name)
        if found is not None:
            folders = found.submodule_search_locations or [found.origin or ""]
            yield from (Path(folder) for folder in folders if folder)


def load_plugins() -> None:
    """Import what installed packages register, once; raises UsageError where that fails."""
    if GROUP in _loaded:
        return
    _loaded.add(GROUP)  # before, since a plug-in may look into a table while it is imported
    for point in plugins():
        try:
            point.load()
        except FAULTS as exc:
            raise UsageError(f"the plug-in {point.name} = {point.value!r} fails: {exc}") from exc
