"""The catalogue of a study: its plug-ins, drivers, prompts and conditions."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType

from merge_runner.config import both_sides
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Block, Variant, blocks_of, with_block
from merge_runner.registry import FAULTS, Catalogue, collecting, require, use
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import OPPONENT, chosen_models, level_text
from merge_runner.study.file import StudyFile, StudyPrompt, StudySource, read_study
from merge_runner.study.trust import require_agreement

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
    for source in plugins.values():
        _import_others(source)
    with collecting(Catalogue(text, plugins)) as catalogue:
        _run_plugins(plugins)
        for name, condition in (file.conditions or {}).items():
            if condition is not None:
                CONDITIONS.register(name, condition)
        for name, prompt in file.prompts.items():
            VARIANTS.register(name, _variant(name, prompt))
        for name, driver in file.drivers.items():
            try:
                program = PROGRAMS.require(driver.program)
                changed = program.with_changes(
                    driver.program, driver.model_extra or {}, driver.clock
                )
            except UsageError as exc:
                raise UsageError(f"[drivers.{name}]: {exc}") from exc
            PROGRAMS.register(name, changed)
    return catalogue


def declared_catalogue(file: StudyFile) -> Catalogue:
    """Return what a study's file declares itself; none of its plug-ins run.

    It has no text, since nobody named that study: another sweep's may take its place.
    Drivers of a program that is not here are left out. Raises UsageError.
    """
    here = {name: driver for name, driver in file.drivers.items() if driver.program in PROGRAMS}
    return catalogue_of(file.model_copy(update={"drivers": here}), "", {})


def _import_others(source: str) -> None:
    """Import what a plug-in imports from elsewhere: what that registers is no part of the study."""
    with suppress(*FAULTS):  # it is told, with its line, when the plug-in runs
        for node in ast.parse(source).body:
            if isinstance(node, ast.Import):
                for alias in node.names:
                    import_module(alias.name)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                import_module(node.module)


@dataclass
class _Source(InspectLoader):
    """A module whose source is given, so that its hash and its text are known everywhere."""

    file: str
    source: str

    def get_source(self, fullname: str) -> str:
        return self.source

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.source, self.file)


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
        loader = _Source(file, source)
        spec = spec_from_loader(name, loader)
        assert spec is not None
        module = sys.modules[name] = module_from_spec(spec)
        try:
            loader.exec_module(module)
        except (UsageError, AssertionError, *FAULTS) as exc:
            lines = [f.lineno for f in extract_tb(exc.__traceback__) if f.filename == file]
            line = lines[-1] if lines else getattr(exc, "lineno", None)
            where = f"{file}, line {line}" if line else file
            said = str(exc) if isinstance(exc, UsageError) else f"{type(exc).__name__}: {exc}"
            raise UsageError(f"the plug-in {where}, fails: {said}") from exc


def _variant(name: str, prompt: StudyPrompt) -> Variant:
    """The variant that a prompt of a study is; raises UsageError."""
    kind = f"block of the prompt {name}"
    before = blocks_of(prompt.based_on)
    for each in prompt.remove:
        require(before, kind, each)
    blocks = {each: block for each, block in before.items() if each not in prompt.remove}
    for each, texts in prompt.replace.items():
        block = require(blocks, kind, each)
        blocks[each] = replace(block, merge=texts.merge, straight=texts.straight)
    for number, added in enumerate(prompt.add, 1):
        block_name = added.block or f"{name}.{number}"
        if block_name in blocks:
            raise UsageError(f"the prompt {name} adds the block {block_name}, which it has already")
        block = (
            Block(f"added by {name}", added.merge, added.straight, before=None)
            if added.block is None
            else BLOCKS.require(added.block, f"the prompt {name} adds it")
        )
        anchor = added.before or added.after
        if anchor is not None:
            require(blocks, kind, anchor)
        blocks = with_block(blocks, block_name, block, anchor, after=added.after is not None)
    return Variant(
        removes=frozenset(each for each, block in before.items() if blocks.get(each) != block),
        adds=frozenset(each for each, block in blocks.items() if before.get(each) != block),
        title=prompt.title,
        blocks=tuple(blocks.items()),
    )
