"""A user's agreement to what a study's folder brings: code that runs, keys that go elsewhere.

It is kept by content in the user's own folder of states, where no study can write.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from merge_runner.config import (
    LOOPBACK,
    PROVIDERS,
    ModelEntry,
    endpoint_url,
    normalised_url,
    state_folder,
    url_origin,
)
from merge_runner.errors import UsageError
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.models import REGISTRY, read_entries, registry_files
from merge_runner.paths import SHIPPED_EXPERIMENTS
from merge_runner.study.file import StudySource
from merge_runner.study.folder import PLUGIN, TEMPLATE
from merge_runner.text_safety import one_line, printable

SHIPPED_REGISTRY = SHIPPED_EXPERIMENTS / REGISTRY
# Who answers, where, with which key, at what price: the rest is how the same model is asked.
IDENTITY = {"provider", "format", "id", "base_url", "path", "key_env", "auth", "price"}


@dataclass(frozen=True)
class Risk:
    """Something that a file of a folder does, in ``words``; ``content`` is what is agreed to."""

    file: Path
    words: str
    content: object
    shown: str = ""

    @property
    def digest(self) -> str:
        """The hash under which an agreement is kept."""
        return _digest([self.words, self.content])

    @property
    def digest_of_folder(self) -> str:
        """The hash under which an agreement to whatever stands in its folder is kept."""
        return _digest(["folder", str(self.file.parent.resolve())])


def require_agreement(study: StudySource, models: Iterable[str], *, trust: bool) -> None:
    """Ask about the study's code, and about where these models' keys go: once for each content.

    ``trust`` agrees. Raises UsageError where the user does not, and where there is no terminal.
    """
    risks = [*_code(study), *_endpoints(study.path.parent, models)]
    agreed = _agreed() if risks else set()
    risks = [risk for risk in risks if not {risk.digest, risk.digest_of_folder} & agreed]
    if not risks:
        return
    answer = "yes" if trust else _ask(risks)
    if answer not in ("y", "yes", "a", "always"):
        raise UsageError("nothing was run")
    whole = answer.startswith("a")
    digests = ((risk.digest_of_folder if whole else risk.digest, risk.file) for risk in risks)
    try:
        _keep(digests)
    except OSError as exc:
        if trust:  # a script says so again
            return
        raise UsageError(
            f"the agreement cannot be kept in {_file()}: {exc.strerror}; name another folder with "
            "XDG_STATE_HOME, or add --trust"
        ) from exc


def _ask(risks: Sequence[Risk]) -> str:
    words = one_line("; ".join(f"{risk.file} {risk.words}" for risk in risks))
    if not sys.stdin.isatty():
        raise UsageError(
            f"{words}. There is no terminal to ask at: read these files, then add --trust (in "
            "Python: trust=True)"
        )
    shown = "".join(risk.shown for risk in risks)
    question = f"{shown}{words}\nGo ahead? [y]es, [N]o, [a]lways in this folder: "
    sys.stderr.write(printable(question))
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower()


def _code(study: StudySource) -> Iterator[Risk]:
    """The plug-ins, but for the one that ``init`` writes, as it writes it."""
    sources = study.plugins
    if sources and sources != {PLUGIN: (TEMPLATE / PLUGIN).read_text(encoding="utf-8")}:
        folder = study.path.parent
        shown = (f"---- {folder / name}\n{source}\n----\n" for name, source in sources.items())
        words = f"runs code ({', '.join(sources)})"
        yield Risk(study.path, words, [*sources.items()], "".join(shown))


def _endpoints(beside: Path, models: Iterable[str]) -> Iterator[Risk]:
    """The models of registries that do not ship, where their calls may not go unasked."""
    files = [path for path in registry_files(beside) if not path.samefile(SHIPPED_REGISTRY)]
    shipped = read_entries(SHIPPED_REGISTRY) if files else {}
    defined = {name: (path, entry) for path in files for name, entry in read_entries(path).items()}
    for name in sorted({*models} & {*defined}):
        path, entry = defined[name]
        if entry.provider not in PROVIDERS:
            continue  # refused later, unless it is a plug-in's
        identity = entry.model_dump(include=IDENTITY)
        replaces = name in shipped and identity != shipped[name].model_dump(include=IDENTITY)
        try:
            if replaces or _goes_elsewhere(entry):
                yield Risk(path, _sending(name, entry, replaces), identity if replaces else None)
        except UsageError as exc:
            raise UsageError(one_line(f"{path}: [{name}]: {exc}")) from exc


def _sending(name: str, entry: ModelEntry, replaces: bool) -> str:
    sent = entry.key_env or " or ".join(PROVIDERS[entry.provider].key_envs) or "prompts"
    instead = ", in place of merge-runner's own" if replaces else ""
    return f"sends {sent} to {url_origin(endpoint_url(entry))} for the model {name}{instead}"


def _goes_elsewhere(entry: ModelEntry) -> bool:
    """Whether a key that is not the provider's is sent, or anything to a URL that is not its own.

    Loopback is the provider's own where that needs no key.
    """
    provider = PROVIDERS[entry.provider]
    if entry.key_env is not None and entry.key_env not in provider.key_envs:
        return True
    if entry.base_url is None or url_origin(entry.base_url) == url_origin(provider.base_url):
        return False
    return provider.key_needed or urlsplit(normalised_url(entry.base_url)).hostname not in LOOPBACK


def _agreed() -> set[str]:
    try:
        return {line.partition(" ")[0] for line in _file().read_text().splitlines()}
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except (OSError, UnicodeDecodeError) as exc:
        raise UsageError(f"{_file()} cannot be read: {exc}") from exc


def _keep(agreements: Iterable[tuple[str, Path]]) -> None:
    _file().parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with _file().open("a", encoding="utf-8") as lines:
        lines.writelines(f"{digest} {one_line(str(file))}\n" for digest, file in agreements)


def _file() -> Path:
    return state_folder() / "agreements"


def _digest(content: object) -> str:
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()
