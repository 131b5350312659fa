"""A user's agreement to what a study's folder brings: code that runs, keys that go elsewhere.

It is kept by content in the user's own folder of states, where no study can write.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

from merge_runner.config import LOOPBACK, PROVIDERS, endpoint_url, state_folder, url_origin
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.models import REGISTRY, read_entries, registry_files
from merge_runner.paths import SHIPPED_EXPERIMENTS
from merge_runner.study.file import PLUGIN, TEMPLATE, StudySource
from merge_runner.text_safety import one_line, printable

SHIPPED_REGISTRY = SHIPPED_EXPERIMENTS / REGISTRY
# Who answers, where, with which key, at what price: the rest is how the same model is asked.
IDENTITY = {"provider", "format", "id", "base_url", "path", "key_env", "auth", "price"}


Risk = tuple[Path, str, object]
"""A file, in words what it does, and the content that is agreed to."""


def require_agreement(study: StudySource, models: Iterable[str], *, trust: bool) -> None:
    """Ask about the study's code, and about where these models' keys go: once for each content.

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
        lines = kept.read_text("utf-8", errors="replace").splitlines() if kept.exists() else []
        for agreed in lines:
            by_digest.pop(agreed.partition(" ")[0], None)
        if not by_digest:
            return
        if not trust:
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
    sys.stderr.write(f"{words}\nGo ahead? [y]es, [N]o: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("nothing was run")


def _endpoints(beside: Path, models: Iterable[str]) -> Iterator[Risk]:
    """The models of registries that do not ship, where their calls may not go unasked.

    That is where one replaces a model that ships, or where a key that is not the provider's is
    sent, or anything to a URL that is not its own. Loopback is the provider's own where that needs
    no key.
    """
    files = [path for path in registry_files(beside) if not path.samefile(SHIPPED_REGISTRY)]
    shipped = read_entries(SHIPPED_REGISTRY) if files else {}
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
        other_key = entry.key_env is not None and entry.key_env not in provider.key_envs
        if replaces or other_key or (elsewhere and not at_home):
            sent = entry.key_env or " or ".join(provider.key_envs) or "prompts"
            instead = ", in place of merge-runner's own" if replaces else ""
            words = f"sends {sent} to {origin} for the model {name}{instead}"
            yield path, words, identity if replaces else None
