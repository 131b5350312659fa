"""The catalogue of a study: its plug-ins, drivers, prompts and conditions."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType

from merge_runner.config import both_sides, validated
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import (
    BLOCKS,
    SITUATION,
    TABLE,
    VARIANTS,
    Block,
    Variant,
    blocks_of,
)
from merge_runner.registry import FAULTS, Catalogue, collecting, use
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import OPPONENT, chosen_models, level_text
from merge_runner.study.file import (
    AddedText,
    StudyDriver,
    StudyFile,
    StudyPrompt,
    StudySource,
    read_study,
)
from merge_runner.study.trust import require_agreement

LAST = "the end"
PACKAGE = "study_plugins"
"""The package of a study's plug-ins: one imports from another by ``from .other import thing``."""


def load_study(
    name: str, models: Sequence[str] | None = None, *, trust: bool = False
) -> StudySource:
    """Read a study and use its catalogue, once the user agrees to its code.

    ``models`` are those that are to be asked, in place of the file's own; None: nobody is asked.
    The user also agrees to where their keys go. ``trust`` agrees. Raises UsageError.
    """
    study = read_study(name)
    file = study.file
    asked: set[str] = set()
    if models is not None:
        opponents = map(level_text, file.factors.get(OPPONENT, ()))
        pairs = map(both_sides, [*chosen_models(file, models), *opponents])
        asked = {name for pair in pairs for name in pair.values()}
    require_agreement(study, asked, trust=trust)
    use(catalogue_of(file, study.text, study.plugins))
    return study


def catalogue_of(file: StudyFile, text: str, plugins: Mapping[str, str]) -> Catalogue:
    """Run a study's plug-ins and return what they and its file add; raises UsageError.

    The user has agreed to the code (``load_study``).
    """
    _import_others(plugins.values())
    with collecting(Catalogue(text, plugins)) as catalogue:
        _run_plugins(plugins)
        for name, condition in (file.conditions or {}).items():
            if condition is not None:
                CONDITIONS.register(name, condition)
        for name, prompt in _by_dependence(file.prompts).items():
            VARIANTS.register(name, _variant(name, prompt))
        for name, driver in file.drivers.items():
            PROGRAMS.register(name, _program(name, driver))
    return catalogue


def declared_catalogue(text: str) -> Catalogue:
    """Return what a study's file declares itself; none of its plug-ins run.

    It has no text, since nobody named that study: another sweep's may take its place.
    Drivers of a program that is not here are left out. Raises UsageError.
    """
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as exc:
        raise UsageError(f"the stored study cannot be read: {exc}") from exc
    file = validated(StudyFile, content, "the stored study")
    here = {name: driver for name, driver in file.drivers.items() if driver.program in PROGRAMS}
    return catalogue_of(file.model_copy(update={"drivers": here}), "", {})


def _import_others(sources: Iterable[str]) -> None:
    """Import what plug-ins import from elsewhere: what that registers is no part of the study."""
    for source in sources:
        with suppress(*FAULTS):  # it is told, with its line, when the plug-in runs
            for node in ast.parse(source).body:
                if isinstance(node, ast.Import):
                    for alias in node.names:
                        import_module(alias.name)
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    import_module(node.module)


def _run_plugins(sources: Mapping[str, str]) -> None:
    """Run plug-ins, given by file name and source, as the modules of one package."""
    for name in [name for name in sys.modules if name.startswith(f"{PACKAGE}.")]:
        del sys.modules[name]
    package = sys.modules[PACKAGE] = ModuleType(PACKAGE)
    package.__path__ = []
    for file, source in sources.items():
        name = f"{PACKAGE}.{re.sub('[^A-Za-z0-9_]', '_', Path(file).stem)}"
        if name in sys.modules:
            raise UsageError(f"plug-ins need different names: {', '.join(sources)}")
        _run(name, _Source(file, source))


def _by_dependence(prompts: Mapping[str, StudyPrompt]) -> dict[str, StudyPrompt]:
    """The prompts, each after the one that it is based on."""
    based_on = {
        name: {prompt.based_on} & prompts.keys() - VARIANTS.keys()
        for name, prompt in prompts.items()
    }
    try:
        return {name: prompts[name] for name in TopologicalSorter(based_on).static_order()}
    except CycleError as exc:
        names = ", ".join(dict.fromkeys(exc.args[1]))
        raise UsageError(f"the prompts {names} are based on each other") from None


@dataclass
class _Source(InspectLoader):
    """A module whose source is given, so that its hash and its text are known everywhere."""

    file: str
    source: str

    def get_source(self, fullname: str) -> str:
        return self.source

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.source, self.file)


def _run(name: str, loader: _Source) -> None:
    spec = spec_from_loader(name, loader)
    assert spec is not None
    module = sys.modules[name] = module_from_spec(spec)
    try:
        loader.exec_module(module)
    except (UsageError, AssertionError, *FAULTS) as exc:
        lines = [f.lineno for f in extract_tb(exc.__traceback__) if f.filename == loader.file]
        line = lines[-1] if lines else getattr(exc, "lineno", None)
        where = f"{loader.file}, line {line}" if line else loader.file
        said = str(exc) if isinstance(exc, UsageError) else f"{type(exc).__name__}: {exc}"
        raise UsageError(f"the plug-in {where}, fails: {said}") from exc


def _program(name: str, driver: StudyDriver) -> Program:
    """The program that a driver of a study is; raises UsageError."""
    try:
        program = PROGRAMS.require(driver.program)
        return program.with_changes(driver.program, driver.model_extra or {}, driver.clock)
    except UsageError as exc:
        raise UsageError(f"[drivers.{name}]: {exc}") from exc


def _variant(name: str, prompt: StudyPrompt) -> Variant:
    """The variant that a prompt of a study is; raises UsageError."""
    before = blocks_of(prompt.based_on)
    for each in prompt.remove:
        _known(name, each, before)
    blocks = {each: block for each, block in before.items() if each not in prompt.remove}
    for each, texts in prompt.replace.items():
        _known(name, each, blocks)
        blocks[each] = replace(blocks[each], merge=texts.merge, straight=texts.straight)
    for number, added in enumerate(prompt.add, 1):
        blocks = _with_added(name, blocks, number, added)
    if {SITUATION, TABLE} <= blocks.keys() and blocks[SITUATION].merge == BLOCKS[SITUATION].merge:
        raise UsageError(
            f"the prompt {name} says the situation twice, in {SITUATION} and in {TABLE}: write "
            f'remove = ["{SITUATION}"]'
        )
    return Variant(
        removes=frozenset(each for each, block in before.items() if blocks.get(each) != block),
        adds=frozenset(each for each, block in blocks.items() if before.get(each) != block),
        title=prompt.title,
        blocks=tuple(blocks.items()),
    )


def _with_added(
    prompt: str, blocks: Mapping[str, Block], number: int, added: AddedText
) -> dict[str, Block]:
    """The blocks with an added one in its place; raises UsageError."""
    if added.block is not None:
        name = added.block
        block = BLOCKS.require(name, f"the prompt {prompt} adds it")
    else:
        name = f"{prompt}.{number}"
        block = Block(f"added by {prompt}", added.merge, added.straight, before=None)
    if name in blocks:
        raise UsageError(f"the prompt {prompt} adds the block {name!r}, which it has already")
    anchor = added.before or added.after or _own_place(block, blocks)
    if anchor is not None:
        _known(prompt, anchor, blocks)
    names = list(blocks)
    place = len(names) if anchor is None else names.index(anchor) + (added.after is not None)
    # Where it stands is a part of its hash.
    block = replace(block, before=[*names, LAST][place])
    names.insert(place, name)
    return {each: blocks.get(each, block) for each in names}


def _own_place(block: Block, blocks: Mapping[str, Block]) -> str | None:
    """What a registered block stands before where its prompt does not say: the first there is."""
    paper = [name for name, each in BLOCKS.items() if each.before is None]
    later = paper[paper.index(block.before) :] if block.before in paper else []
    return next((name for name in later if name in blocks), None)


def _known(prompt: str, block: str, blocks: Mapping[str, Block]) -> None:
    if block not in blocks:
        known = ", ".join(blocks)
        elsewhere = " (which another prompt has)" if block in BLOCKS else ""
        raise UsageError(
            f"the prompt {prompt} names the block {block!r}{elsewhere}; those that it has: {known}"
        )
