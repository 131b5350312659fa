"""The catalogue of a study: its plug-ins, drivers, prompts and conditions, once its user agrees."""

from __future__ import annotations

import ast
import hashlib
import re
import sys
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType
from urllib.parse import urlsplit

from merge_runner.config import (
    LOOPBACK,
    PROVIDERS,
    both_sides,
    endpoint_url,
    state_folder,
    url_origin,
)
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import UsageError
from merge_runner.llm.models import REGISTRY, read_entries, registry_files
from merge_runner.paths import SHIPPED_EXPERIMENTS
from merge_runner.prompts.blocks import (
    BLOCKS,
    VARIANTS,
    WORDS,
    Block,
    Variant,
    blocks_of,
    with_block,
)
from merge_runner.records import canonical_json
from merge_runner.registry import FAULTS, NAME, Catalogue, collecting, installing, require
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import OPPONENT, chosen_models, level_text
from merge_runner.study.file import (
    PLUGIN,
    TEMPLATE,
    StudyFile,
    StudyPrompt,
    StudySource,
    StudyText,
    read_study,
)
from merge_runner.text_safety import one_line, printable, say

# Who answers, where, with which key, at what price: the rest is how the same model is asked.
IDENTITY = {"provider", "format", "id", "base_url", "path", "key_env", "auth", "price"}
_importing = threading.RLock()
_parsing = threading.Lock()  # Python 3.11 counts the depth of a tree for all threads
STUDY_PLUGINS = "study_plugins"
"""The package of a study's plug-ins, with a hash behind it: those of two studies are two."""


def load_study(
    name: str | StudySource,
    models: Sequence[str] | None = None,
    *,
    trust: bool = False,
    own: Catalogue | None = None,
) -> tuple[StudySource, Catalogue]:
    """Read a study, and return it with what it adds, once the user agrees to its code.

    ``own`` are parts that were registered for it. ``models`` are those that are to be asked, in
    place of the file's own; None: nobody is asked. The user also agrees to where their keys go.
    ``trust`` agrees. Raises UsageError.
    """
    study = read_study(name) if isinstance(name, str) else name
    file = study.file
    asked: set[str] = set()
    if models is not None:
        opponents = map(level_text, file.factors.get(OPPONENT, ()))
        pairs = map(both_sides, [*chosen_models(file, models), *opponents])
        asked = {name for pair in pairs for name in pair.values()}
    _require_agreement(study, asked, trust=trust)
    return study, catalogue_of(file, study.text, study.plugins, own)


def _require_agreement(study: StudySource, models: Iterable[str], *, trust: bool) -> None:
    """Ask about the study's code, and about where these models' keys go: once for each content.

    What is agreed to is kept in the user's own folder of states, where no study can write.
    ``trust`` agrees. Raises UsageError where the user does not, and where there is no terminal.
    """
    risks, code = [*_endpoints(study.path.parent, models)], study.plugins
    # The plug-in that ``init`` writes is ours, as it writes it.
    if code and code != {PLUGIN: (TEMPLATE / PLUGIN).read_text(encoding="utf-8")}:
        risks.insert(0, (study.path, f"runs code ({', '.join(code)})", [*code.items()]))
    if not risks:
        return
    by_digest = {
        hashlib.sha256(canonical_json([words, content]).encode()).hexdigest(): (file, words)
        for file, words, content in risks
    }
    kept = state_folder() / "agreements"
    try:
        for line in kept.read_text("utf-8", "replace").splitlines() if kept.exists() else ():
            by_digest.pop(line.partition(" ")[0], None)
        if by_digest and not trust:
            _ask(study, by_digest.values())
        kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with kept.open("a", encoding="utf-8") as file:
            file.writelines(f"{n} {one_line(str(path))}\n" for n, (path, _) in by_digest.items())
    except OSError as exc:
        if not trust:  # a script says so again
            raise UsageError(
                f"the agreement cannot be kept in {kept}: {exc.strerror}; name another folder with "
                "XDG_STATE_HOME, or add --trust"
            ) from exc


def _ask(study: StudySource, risks: Collection[tuple[Path, str]]) -> None:
    """Show what files do, and code that is to run; raise UsageError unless the user agrees."""
    words = one_line("; ".join(f"{file} {does}" for file, does in risks))
    if not sys.stdin.isatty():
        raise UsageError(
            f"{words}. There is no terminal to ask at: read these files, then add --trust (in "
            "Python: trust=True)"
        )
    if study.path in [file for file, _ in risks]:
        for name, source in study.plugins.items():
            sys.stderr.write(printable(f"---- {study.path.parent / name}\n{source}\n----\n"))
    say(words)
    sys.stderr.write("Go ahead? [y]es, [N]o: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("nothing was run")


def _endpoints(beside: Path, models: Iterable[str]) -> Iterator[tuple[Path, str, object]]:
    """The models of registries that do not ship, where their calls may not go unasked.

    That is where one replaces a model that ships, or where a key that is not the provider's is
    sent, or anything to a URL that is not its own. Loopback is the provider's own where that needs
    no key. Of each its file, what it does in words, and the content that is agreed to.
    """
    ours = SHIPPED_EXPERIMENTS / REGISTRY
    files = [path for path in registry_files(beside) if not path.samefile(ours)]
    shipped = read_entries(ours) if files else {}
    defined = {name: (path, entry) for path in files for name, entry in read_entries(path).items()}
    for name in sorted({*models} & {*defined}):
        path, entry = defined[name]
        provider = PROVIDERS.get(entry.provider)
        if provider is None:
            continue  # refused later, unless it is a plug-in's
        identity = entry.model_dump(include=IDENTITY)
        replaces = name in shipped and identity != shipped[name].model_dump(include=IDENTITY)
        try:
            origin = url_origin(endpoint_url(entry))
            elsewhere = entry.base_url is not None and origin != url_origin(provider.base_url)
        except UsageError as exc:
            raise UsageError(one_line(f"{path}: [{name}]: {exc}")) from exc
        at_home = not provider.key_needed and urlsplit(origin).hostname in LOOPBACK
        if (
            replaces
            or entry.key_env not in (None, *provider.key_envs)
            or (elsewhere and not at_home)
        ):
            sent = entry.key_env or " or ".join(provider.key_envs) or "prompts"
            instead = ", in place of merge-runner's own" if replaces else ""
            words = f"sends {sent} to {origin} for the model {name}{instead}"
            yield path, words, identity if replaces else None


def catalogue_of(
    file: StudyFile, text: str, plugins: Mapping[str, str], own: Catalogue | None = None
) -> Catalogue:
    """Run a study's plug-ins and return what they and its file add to its ``own`` parts.

    The user has agreed to the code (``load_study``). Raises UsageError.
    """
    for source in plugins.values():
        _import_others(source)
    parts = {kind: dict(things) for kind, things in own.parts.items()} if own else {}
    with collecting(Catalogue(text, plugins, parts)) as catalogue:
        _run_plugins(plugins)
        for name, condition in (file.conditions or {}).items():
            if condition is not None:
                CONDITIONS.register(name, condition)
        for name, prompt in file.prompts.items():
            VARIANTS.register(name, _variant(name, prompt))
        for factor, texts in file.texts.items():
            for level in texts:
                if not NAME.fullmatch(level):
                    raise UsageError(
                        f"[texts.{factor}]: the level {level!r} needs a name of letters, digits, _ "
                        "- and ."
                    )
            changes = {lv: partial(_changed, f"{factor}={lv}", text) for lv, text in texts.items()}
            WORDS.register(factor, changes)
        for name, driver in file.drivers.items():
            changes = driver.model_extra or {}
            try:
                program = PROGRAMS.require(driver.program)
                changed = program.with_changes(driver.program, changes, driver.clock)
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
    names: list[str] = []
    with suppress(*FAULTS):  # it is told, with its line, when the plug-in runs
        with _parsing:
            body = ast.parse(source).body
        for node in body:
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.append(node.module)
    for name in names:
        with suppress(UsageError, *FAULTS), installing():
            import_module(name)


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
    """Run plug-ins, given by file name and source, as the modules of one package.

    One imports from another by ``from .other import thing``. The package is called by a hash of
    its sources, so that no study finds the modules of another one.
    """
    digest = hashlib.sha256(canonical_json([*sources.items()]).encode()).hexdigest()
    package = f"{STUDY_PLUGINS}_{digest[:16]}"
    named = {
        f"{package}.{re.sub('[^A-Za-z0-9_]', '_', Path(file).stem)}": (file, source)
        for file, source in sources.items()
    }
    if len(named) < len(sources):
        raise UsageError(f"plug-ins need different names: {', '.join(sources)}")
    with _importing:
        sys.modules.setdefault(package, ModuleType(package)).__path__ = []
        for name, (file, source) in named.items():
            _run_plugin(name, file, source)


def _run_plugin(name: str, file: str, source: str) -> None:
    loader = _Source(file, source)
    spec = spec_from_loader(name, loader)
    assert spec is not None
    module = module_from_spec(spec)
    # The one before stays until this one is complete: a driver that runs may import from it.
    sys.modules.setdefault(name, module)
    try:
        loader.exec_module(module)
        sys.modules[name] = module
    except (UsageError, AssertionError, *FAULTS) as exc:
        lines = [f.lineno for f in extract_tb(exc.__traceback__) if f.filename == file]
        line = lines[-1] if lines else getattr(exc, "lineno", None)
        where = f"{file}, line {line}" if line else file
        said = str(exc) if isinstance(exc, UsageError) else f"{type(exc).__name__}: {exc}"
        raise UsageError(f"the plug-in {where}, fails: {said}") from exc


def _variant(name: str, prompt: StudyPrompt) -> Variant:
    """The variant that a prompt of a study is; raises UsageError."""
    before = blocks_of(prompt.based_on)
    blocks = _changed(name, prompt, before)
    return Variant(
        removes=frozenset(each for each, block in before.items() if blocks.get(each) != block),
        adds=frozenset(each for each, block in blocks.items() if before.get(each) != block),
        title=prompt.title,
        blocks=tuple(blocks.items()),
    )


def _changed(
    name: str, change: StudyPrompt | StudyText, before: Mapping[str, Block]
) -> dict[str, Block]:
    """The blocks of a prompt that is changed to the one of this name; raises UsageError."""
    kind = f"block of the prompt {name}"
    blocks = dict(before)
    earlier = [each for each, block in before.items() if block.before is not None]
    for each in change.remove:
        require(blocks, kind, each)
        del blocks[each]
    for each, texts in change.replace.items():
        block = require(blocks, kind, each)
        blocks[each] = replace(block, merge=texts.merge, straight=texts.straight)
    for number, added in enumerate(change.add, 1):
        block_name, anchor = added.block or f"{name}.{number}", added.before or added.after
        if block_name in blocks:
            raise UsageError(f"the prompt {name} adds the block {block_name}, which it has already")
        if added.block is None:
            block = Block(f"added by {name}", added.merge, added.straight, before=None)
        else:
            block = BLOCKS.require(added.block, f"the prompt {name} adds it")
        if anchor is not None:
            require(blocks, kind, anchor)
        after = added.after is not None
        blocks = with_block(blocks, block_name, block, anchor, after=after, earlier=earlier)
    return blocks
