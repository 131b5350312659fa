"""Tables of parts by kind (drivers, blocks, conditions, ...), which packages and studies add to.

An installed package names a module under the entry point group ``merge_runner``. It is imported
before the first look-up in any table, and registers its parts:

    [project.entry-points.merge_runner]
    anything = "my_package.my_drivers"

After that the tables are complete. A study's own parts are in its ``Catalogue``, which the tables
include where it is in use: in one thread, or in one task of an event loop and the tasks it starts.
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
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from merge_runner.errors import UsageError, unknown_name
from merge_runner.text_safety import one_line

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "merge_runner"
# A name is a part of trial ids, of the command line and of addresses.
NAME = re.compile(r"[A-Za-z0-9_.-]+")
T = TypeVar("T")


@dataclass(frozen=True, eq=False, slots=True)
class Catalogue:
    """Parts that a study adds, by kind and name.

    ``text`` is the study's file, empty where no study is loaded; ``plugins`` has the sources of its
    plug-ins by file name.
    """

    text: str = ""
    plugins: Mapping[str, str] = field(default_factory=dict)
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)


NO_STUDY = Catalogue()
_in_use: ContextVar[Catalogue] = ContextVar("_in_use", default=NO_STUDY)
_collecting: ContextVar[bool] = ContextVar("_collecting", default=False)
_installing: ContextVar[bool] = ContextVar("_installing", default=False)


def require(things: Mapping[str, T], kind: str, name: str, hint: str = "") -> T:
    """Return the thing of this name; raise UsageError."""
    try:
        return things[name]
    except KeyError:
        raise unknown_name(kind, name, things, hint) from None


class Registry(Mapping[str, T]):
    """Things of one kind by name, in the order of registration."""

    made: ClassVar[list[Registry[Any]]] = []

    def __init__(self, kind: str) -> None:
        """Make an empty table; messages call one of its things ``kind``."""
        self.kind = kind
        self._things: dict[str, T] = {}
        self.is_complete = False  # then installed packages alone add things
        self.made.append(self)

    def register(self, name: str, thing: T) -> T:
        """Add a thing, and return it.

        It belongs to the study whose plug-in registers it. Raise UsageError if the name is taken or
        invalid, or if plug-ins were looked up before and none of them registers it.
        """
        if not NAME.fullmatch(name):
            raise UsageError(f"the {self.kind} {name!r} needs a name of letters, digits, _ - and .")
        if name in self._things or name in in_use().parts.get(self.kind, {}):
            raise UsageError(f"there is a {self.kind} {name!r} already")
        if _collecting.get():
            in_use().parts.setdefault(self.kind, {})[name] = thing
        elif self.is_complete and not _installing.get():
            raise UsageError(
                f"the {self.kind} {name!r} comes too late: register it in a plug-in of a study "
                "(`files` of [plugins]), by Study.register, or in a module that an installed "
                f"package names under the entry point group {GROUP}"
            )
        else:
            self._things[name] = thing
        return thing

    def require(self, name: str, hint: str = "") -> T:
        """Return the thing of this name; raise UsageError with the valid names."""
        return require(self, self.kind, name, hint)

    @property
    def _all(self) -> ChainMap[str, T]:
        """Parts of packages and of the study in use; ``register`` prevents equal names."""
        load_plugins()
        if not _installing.get():
            self.is_complete = True
        return ChainMap(in_use().parts.get(self.kind, {}), self._things)

    def __getitem__(self, name: str) -> T:
        return self._all[name]

    def items(self) -> ItemsView[str, T]:
        """Return all names and things by one look-up."""
        return self._all.items()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


def in_use() -> Catalogue:
    """Return the catalogue of the study in use."""
    return _in_use.get()


def use(catalogue: Catalogue) -> None:
    """Use this catalogue from now on in this context: a thread, or a task and those it starts.

    A new thread has it only in a copy of the context. It is for a process that serves one study,
    such as a command or a worker.
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
    """Use this catalogue within a ``with`` block."""
    with _set(_in_use, catalogue):
        yield


@contextmanager
def collecting(catalogue: Catalogue) -> Iterator[Catalogue]:
    """Register parts into a catalogue within a ``with`` block, and use it there."""
    load_plugins()  # first: a study may build on installed parts
    with _set(_in_use, catalogue), _set(_collecting, True):
        yield catalogue


@contextmanager
def installing() -> Iterator[None]:
    """Register installed parts within a ``with`` block."""
    with _set(_installing, True), _set(_collecting, False):
        yield


_of_results: dict[Path, Catalogue] = {}


def remember(db: Path, catalogue: Catalogue) -> None:
    """Keep the catalogue of the study that stores its trials in this database."""
    _of_results[db.absolute()] = catalogue


def in_use_for(db: Path) -> Catalogue:
    """Return the catalogue in use, or else of the study last planned into ``db``."""
    return in_use() if in_use().text else _of_results.get(db.absolute(), in_use())


# Errors that a plug-in's code may raise.
FAULTS = (ArithmeticError, AssertionError, AttributeError, ImportError, LookupError, NameError,
          OSError, RuntimeError, SyntaxError, TypeError, ValueError)  # fmt: skip
_loading = threading.RLock()
_loaded: list[UsageError | None] = []  # the error or None, once all are imported


def fault_of(what: str, error: BaseException) -> UsageError:
    """Return an error of a plug-in's code as one line, with the place where it was raised."""
    package, frames = Path(__file__).parent, extract_tb(error.__traceback__)
    foreign = [frame for frame in frames if package not in Path(frame.filename).parents]
    place = (foreign or frames)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    return UsageError(f"{what} fails in {where}: {one_line(f'{type(error).__name__}: {error}')}")


def plugins() -> list[EntryPoint]:
    """Return the entry points of installed packages, in the order of their import."""
    from importlib.metadata import distribution, distributions

    # entry_points() would take three times as long: it parses the files of all packages.
    texts = ((package, package.read_text("entry_points.txt")) for package in distributions())
    names = {package.name for package, text in texts if text and GROUP in text}
    points = [p for name in names for p in distribution(name).entry_points.select(group=GROUP)]
    return sorted(points, key=lambda point: (point.value, point.name))


def plugin_sources() -> Iterator[Path]:
    """Yield the folder of each plug-in's package, or the file of its module."""
    for name in dict.fromkeys(point.module.partition(".")[0] for point in plugins()):
        spec = find_spec(name)
        if spec is not None:
            folders = spec.submodule_search_locations or [spec.origin or ""]
            yield from (Path(folder) for folder in folders if folder)


def load_plugins() -> None:
    """Import all plug-ins of installed packages, once; raise UsageError if one fails."""
    with _loading:
        if not _loaded:
            _loaded.append(None)  # before the import: a plug-in may look up a table
            with installing():
                _loaded[0] = _import_all()
            for registry in Registry.made:
                registry.is_complete = True
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
