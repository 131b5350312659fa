"""What may vary, each kind in one table that packages from outside can add to.

An installed package that names a module under the entry point group ``merge_runner`` has it
imported before the first look into any table; what it registers is then as good as built in:

    [project.entry-points.merge_runner]
    anything = "my_package.my_drivers"

The tables are complete once that is done. What a study adds is in a ``Catalogue`` of its own, which
the tables show where it is in use: in one thread, or one task of an event loop, and what it begins.
"""

from __future__ import annotations

import re
import threading
from collections import ChainMap
from collections.abc import ItemsView, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
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


NO_STUDY = Catalogue()
_in_use: ContextVar[Catalogue] = ContextVar("_in_use", default=NO_STUDY)
_collecting: ContextVar[bool] = ContextVar("_collecting", default=False)
_installing: ContextVar[bool] = ContextVar("_installing", default=False)


def require(things: Mapping[str, T], kind: str, name: str, hint: str = "") -> T:
    """The thing of this name; raises UsageError."""
    try:
        return things[name]
    except KeyError:
        raise unknown_name(kind, name, things, hint) from None


class Registry(Mapping[str, T]):
    """The things of one kind by name, in the order in which they were registered."""

    made: ClassVar[list[Registry[Any]]] = []

    def __init__(self, kind: str) -> None:
        """``kind`` is what one of them is called in messages."""
        self.kind = kind
        self._things: dict[str, T] = {}
        self._complete = False
        self.made.append(self)

    def register(self, name: str, thing: T) -> T:
        """Add a thing, and return it.

        It belongs to the study whose plug-in registers it. Raises UsageError where the name is
        taken or odd, and where it belongs neither to a study nor to an installed package.
        """
        if not NAME.fullmatch(name):
            raise UsageError(f"the {self.kind} {name!r} needs a name of letters, digits, _ - and .")
        if name in self._things or name in in_use().parts.get(self.kind, {}):
            raise UsageError(f"there is a {self.kind} {name!r} already")
        if _collecting.get():
            in_use().parts.setdefault(self.kind, {})[name] = thing
        elif self._complete and not _installing.get():
            raise UsageError(
                f"the {self.kind} {name!r} comes too late: register it in a plug-in of a study "
                "(`files` of [plugins]), by Study.register, or in a module that an installed "
                f"package names under the entry point group {GROUP}"
            )
        else:
            self._things[name] = thing
        return thing

    def complete(self) -> None:
        """Take nothing more but from installed packages."""
        self._complete = True

    def require(self, name: str, hint: str = "") -> T:
        """See ``require``."""
        return require(self, self.kind, name, hint)

    @property
    def _all(self) -> ChainMap[str, T]:
        """Those of the study, and before them those that are installed."""
        load_plugins()
        if not _installing.get():
            self.complete()
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
    """Return the catalogue that the registries show here beside what is installed."""
    return _in_use.get()


def use(catalogue: Catalogue) -> None:
    """Show this catalogue in the registries from now on, in this thread and what it begins.

    That is for a process that serves one study, as a command or a worker does.
    """
    _in_use.set(catalogue)


@contextmanager
def _set(variable: ContextVar[T], value: T) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@contextmanager
def using(catalogue: Catalogue) -> Iterator[None]:
    """Show this catalogue in the registries meanwhile, to what runs within."""
    with _set(_in_use, catalogue):
        yield


@contextmanager
def collecting(catalogue: Catalogue) -> Iterator[Catalogue]:
    """Put what is registered within into a catalogue, and show it meanwhile."""
    load_plugins()  # first: a study may build on what is installed
    with _set(_in_use, catalogue), _set(_collecting, True):
        yield catalogue


@contextmanager
def installing() -> Iterator[None]:
    """Take what is registered within for a part of what is installed."""
    with _set(_installing, True), _set(_collecting, False):
        yield


_of_results: dict[Path, Catalogue] = {}


def remember(db: Path, catalogue: Catalogue) -> None:
    """Let the tables of a database show what the study adds that stores its trials there."""
    _of_results[db.absolute()] = catalogue


def in_use_for(db: Path) -> Catalogue:
    """Return the catalogue in use, or else that of the study that was last planned into ``db``."""
    return in_use() if in_use().text else _of_results.get(db.absolute(), in_use())


# What the code of somebody else may raise while it is imported.
FAULTS = (ArithmeticError, AttributeError, ImportError, LookupError, NameError, OSError,
          RuntimeError, SyntaxError, TypeError, ValueError)  # fmt: skip
_loading = threading.RLock()
_loaded: list[UsageError | None] = []  # what went wrong, once all are imported


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
    """Import what installed packages register, once; raises UsageError where that has failed."""
    with _loading:
        if not _loaded:
            _loaded.append(None)  # before, since a plug-in may look into a table meanwhile
            with installing():
                _loaded[0] = _import_all()
            for registry in Registry.made:
                registry.complete()
    if (failure := _loaded[0]) is not None:
        raise UsageError(str(failure)) from failure.__cause__


def _import_all() -> UsageError | None:
    for point in plugins():
        try:
            point.load()
        except (UsageError, *FAULTS) as exc:
            failure = UsageError(f"the plug-in {point.name} = {point.value!r} fails: {exc}")
            failure.__cause__ = exc
            return failure
    return None
