"""What may vary, each kind in one table that packages from outside can add to.

An installed package that names a module under the entry point group ``merge_runner`` has it
imported before the first look into any table; what it registers is then as good as built in:

    [project.entry-points.merge_runner]
    anything = "my_package.my_drivers"

What a study adds is in a ``Catalogue`` of its own, which the tables show while it is in use.
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import ItemsView, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from merge_runner.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "merge_runner"
# What can stand in a trial's id, on the command line and in an address.
NAME = re.compile(r"[A-Za-z0-9_.-]+")
T = TypeVar("T")


@dataclass(frozen=True, eq=False, slots=True)
class Catalogue:
    """The parts that a study adds, by kind and name.

    ``text`` is the study's file, ``plugins`` the sources of its plug-ins by file name.
    """

    text: str = ""
    plugins: Mapping[str, str] = field(default_factory=dict)
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)


def require(things: Mapping[str, T], kind: str, name: str, hint: str = "") -> T:
    """The thing of this name; raises UsageError."""
    try:
        return things[name]
    except KeyError:
        raise unknown_name(kind, name, things, hint) from None


class Registry(Mapping[str, T]):
    """The things of one kind by name, in the order in which they were registered."""

    catalogue: ClassVar[Catalogue] = Catalogue()
    collecting: ClassVar[bool] = False

    def __init__(self, kind: str) -> None:
        """``kind`` is what one of them is called in messages."""
        self.kind = kind
        self._things: dict[str, T] = {}
        self._replaceable: set[str] = set()

    def register(self, name: str, thing: T) -> T:
        """Add a thing, and return it; raises UsageError where the name is taken or odd."""
        if not NAME.fullmatch(name):
            raise UsageError(f"the {self.kind} {name!r} needs a name of letters, digits, _ - and .")
        if name in self._things or name in in_use().parts.get(self.kind, {}):
            raise UsageError(f"there is a {self.kind} {name!r} already")
        things = in_use().parts.setdefault(self.kind, {}) if self.collecting else self._things
        things[name] = thing
        return thing

    def replace(self, name: str, thing: T) -> T:
        """Like ``register``, but in place of what was registered here by ``replace`` before."""
        if name in self._replaceable:
            del self._things[name]
        self.register(name, thing)
        self._replaceable.add(name)
        use(replace(in_use()))  # another object, so that nothing derived from the old thing is kept
        return thing

    def require(self, name: str, hint: str = "") -> T:
        """See ``require``."""
        return require(self, self.kind, name, hint)

    @property
    def _all(self) -> ChainMap[str, T]:
        """Those of the study, and before them those that are installed."""
        load_plugins()
        return ChainMap(in_use().parts.get(self.kind, {}), self._things)

    def __getitem__(self, name: str) -> T:
        return self._all[name]

    def items(self) -> ItemsView[str, T]:
        """All names and things, looked up at once."""
        return self._all.items()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


def in_use() -> Catalogue:
    """Return the catalogue that the registries show beside what is installed."""
    return Registry.catalogue


def use(catalogue: Catalogue) -> None:
    """Show this catalogue in the registries, in place of the one before."""
    Registry.catalogue = catalogue


@contextmanager
def collecting(catalogue: Catalogue) -> Iterator[Catalogue]:
    """Put what is registered meanwhile into a catalogue, and then use the one before again."""
    load_plugins()  # first: a study may build on what is installed
    before = in_use()
    Registry.catalogue, Registry.collecting = catalogue, True
    try:
        yield catalogue
    finally:
        Registry.catalogue, Registry.collecting = before, False


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
