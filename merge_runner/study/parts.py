"""Registration of a study's plug-ins, drivers, prompts and conditions, after the user's consent."""

from __future__ import annotations

import builtins
import hashlib
import re
import sys
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.abc import InspectLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType
from typing import Any
from urllib.parse import urlsplit

from merge_runner.config import state_folder
from merge_runner.driver_names import both_sides
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
from merge_runner.providers import LOOPBACK, PROVIDERS, endpoint_url, url_origin
from merge_runner.records import canonical_json
from merge_runner.registry import FAULTS, NAME, Catalogue, collecting, installing, require
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.arms import OPPONENT, level_text
from merge_runner.study.crossing import chosen_models
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

# Fields that identify the model, its server, key and price.
IDENTITY = {"provider", "format", "id", "base_url", "path", "key_env", "auth", "price"}
_importing = threading.RLock()
STUDY_PLUGINS = "study_plugins"
"""Prefix of the package of a study's plug-ins; a hash follows, so that studies do not share it."""


def load_study(
    named: str | StudySource,
    models: Sequence[str] | None = None,
    *,
    trust: bool = False,
    registered: Catalogue | None = None,
) -> tuple[StudySource, Catalogue]:
    """Read a study, and return it with its catalogue after the user's consent to its code.

    ``named`` is its name, its path, or its source if it has been read. ``registered`` are parts
    that were registered for it. ``models`` replace the file's models; an empty sequence replaces
    none, and None means that no model is called. Consent also covers the servers that get keys.
    ``trust`` gives consent. Raises UsageError.
    """
    study = read_study(named) if isinstance(named, str) else named
    file = study.file
    called: set[str] = set()
    if models is not None:
        opponents = map(level_text, file.factors.get(OPPONENT, ()))
        pairs = map(both_sides, [*chosen_models(file, models), *opponents])
        called = {name for pair in pairs for name in pair.values()}
    _require_consent(study, called, trust=trust)
    return study, catalogue_of(file, study.text, study.plugins, registered)


def _require_consent(study: StudySource, models: Iterable[str], *, trust: bool) -> None:
    """Ask for consent to the study's code and to the servers that get keys, once for each content.

    Consent is stored in the user's state folder. ``trust`` gives it, and goes on where it cannot be
    stored. Raises UsageError without consent, and without a terminal.
    """
    risks, code = [*_endpoints(study.path.parent, models)], study.plugins
    # The unedited plug-in of ``init`` is our own code.
    if code and code != {PLUGIN: (TEMPLATE / PLUGIN).read_text(encoding="utf-8")}:
        risks.insert(0, (study.path, f"runs code ({', '.join(code)})", [*code.items()]))
    if not risks:
        return
    by_digest = {
        hashlib.sha256(canonical_json([words, content]).encode()).hexdigest(): (file, words)
        for file, words, content in risks
    }
    record = state_folder() / "agreements"
    try:
        for line in record.read_text("utf-8", "replace").splitlines() if record.exists() else ():
            by_digest.pop(line.partition(" ")[0], None)
        if not by_digest:
            return
        if not trust:
            _ask(study, by_digest.values())
        record.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with record.open("a", encoding="utf-8") as file:
            file.writelines(f"{n} {one_line(str(path))}\n" for n, (path, _) in by_digest.items())
    except OSError as exc:
        if not trust:
            raise UsageError(
                f"the agreement cannot be stored in {record}: {exc.strerror}; name another folder "
                "with XDG_STATE_HOME, or add --trust"
            ) from exc


def _ask(study: StudySource, risks: Collection[tuple[Path, str]]) -> None:
    """Show the risks and the code, and ask for consent; raise UsageError without it."""
    words = one_line("; ".join(f"{file} {does}" for file, does in risks))
    if not sys.stdin.isatty():
        raise UsageError(
            f"{words}. There is no terminal to ask at, which would show the code: read these "
            "files, then add --trust (in Python: trust=True)"
        )
    if study.path in [file for file, _ in risks]:
        for name, source in study.plugins.items():
            sys.stderr.write(printable(f"---- {name} of {study.path}\n{source}\n----\n"))
    say(words)
    sys.stderr.write("Go ahead? [y]es, [N]o: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("nothing was run")


def _endpoints(folder: Path, models: Iterable[str]) -> Iterator[tuple[Path, str, object]]:
    """Yield the models whose endpoints need consent: (file, description, content to consent to).

    They are entries of a user's models.toml that replace a shipped model, take a key from a
    variable that is not the provider's, or have a ``base_url`` with another scheme, host or port
    than the provider's. Such a URL on loopback needs no consent if the provider needs no key.
    """
    shipped_file = SHIPPED_EXPERIMENTS / REGISTRY
    files = [path for path in registry_files(folder) if not path.samefile(shipped_file)]
    shipped = read_entries(shipped_file) if files else {}
    defined = {name: (path, entry) for path in files for name, entry in read_entries(path).items()}
    for name in sorted({*models} & {*defined}):
        path, entry = defined[name]
        provider = PROVIDERS.get(entry.provider)
        if provider is None:
            continue  # refused later, unless a plug-in registers it
        identity = entry.model_dump(include=IDENTITY)
        replaces = name in shipped and identity != shipped[name].model_dump(include=IDENTITY)
        try:
            origin = url_origin(endpoint_url(entry))
            is_foreign = entry.base_url is not None and origin != url_origin(provider.base_url)
        except UsageError as exc:
            raise UsageError(one_line(f"{path}: [{name}]: {exc}")) from exc
        is_local = not provider.key_needed and urlsplit(origin).hostname in LOOPBACK
        if (
            replaces
            or entry.key_env not in (None, *provider.key_envs)
            or (is_foreign and not is_local)
        ):
            sent = entry.key_env or " or ".join(provider.key_envs) or "prompts"
            replacing = ", in place of merge-runner's own" if replaces else ""
            words = f"sends {sent} to {origin} for the model {name}{replacing}"
            yield path, words, identity if replaces else None


def catalogue_of(
    file: StudyFile, text: str, plugins: Mapping[str, str], registered: Catalogue | None = None
) -> Catalogue:
    """Run a study's plug-ins and return the catalogue of its parts.

    It has the parts of the plug-ins, of the file and those ``registered`` before. The user has
    given consent to the code (``load_study``). Raises UsageError.
    """
    known = registered.parts if registered else {}
    parts = {kind: dict(things) for kind, things in known.items()}
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
    """Return the catalogue of a study file's declarations, without its plug-ins.

    Its text is empty, so that it does not count as a loaded study. Drivers of unregistered programs
    are left out. Raises UsageError.
    """
    known = {name: driver for name, driver in file.drivers.items() if driver.program in PROGRAMS}
    return catalogue_of(file.model_copy(update={"drivers": known}), "", {})


def _import(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 # as the built-in function
    """Import a module for an import statement of a plug-in.

    What it registers counts as installed, not as the study's: a later study does not run it again.
    """
    with installing():
        return __import__(*args, **kwargs)


@dataclass
class _Source(InspectLoader):
    """Loader of a module from its source text, whose hash is known."""

    file: str
    source: str

    def get_source(self, fullname: str) -> str:
        return self.source

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.source, self.file)


def _run_plugins(sources: Mapping[str, str]) -> None:
    """Run plug-ins, given by file name and source, as the modules of one package.

    They run in this order: each imports from those before it by ``from .other import thing``. The
    package's name has a hash of the sources, so that studies do not share modules.
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
    vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import}
    # An earlier module stays until this one is complete: a running driver may import from it.
    sys.modules.setdefault(name, module)
    try:
        loader.exec_module(module)
        sys.modules[name] = module
    except (UsageError, *FAULTS) as exc:
        lines = [f.lineno for f in extract_tb(exc.__traceback__) if f.filename == file]
        line = lines[-1] if lines else getattr(exc, "lineno", None)
        where = f"{file}, line {line}" if line else file
        reason = str(exc) if isinstance(exc, UsageError) else f"{type(exc).__name__}: {exc}"
        raise UsageError(f"the plug-in {where}, fails: {reason}") from exc


def _variant(name: str, prompt: StudyPrompt) -> Variant:
    before = blocks_of(prompt.based_on)
    blocks = _changed(name, prompt, before)
    return Variant(
        removes=frozenset(n for n, block in before.items() if blocks.get(n) != block),
        adds=frozenset(n for n, block in blocks.items() if before.get(n) != block),
        title=prompt.title,
        blocks=tuple(blocks.items()),
    )


def _changed(
    name: str, change: StudyPrompt | StudyText, before: Mapping[str, Block]
) -> dict[str, Block]:
    """Return the blocks of a prompt after a change of this name; raises UsageError."""
    kind = f"block of the prompt {name}"
    blocks = dict(before)
    earlier = [n for n, block in before.items() if block.before is not None]
    for removed in change.remove:
        require(blocks, kind, removed)
        del blocks[removed]
    for replaced, texts in change.replace.items():
        block = require(blocks, kind, replaced)
        blocks[replaced] = replace(block, merge=texts.merge, straight=texts.straight)
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
