"""The study as it was designed: its description, its factors and conditions, and its prompts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import unified_diff

from merge_runner.prompts.blocks import title_of
from merge_runner_analysis.data.load import load_each
from merge_runner_analysis.data.study import Study, levels_of
from merge_runner_analysis.names import BASELINE, DESCRIPTIONS

# What each variant asks first: of all of them in the same condition, as far as that was played.
PROMPTS = """
SELECT variant, spec_hash, arg_min(prompt, (condition, decisions.side, trial_id)) AS prompt
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE decision = 0 AND prompt IS NOT NULL GROUP BY variant, spec_hash
ORDER BY min((condition, decisions.side, trial_id)) DESC
"""


@dataclass(frozen=True, slots=True)
class Design:
    """What a report says before any result.

    ``rows`` name the levels of each factor, the conditions and the trials; ``prompts`` have a title
    and the text of the first prompt, of variants the lines that differ from the baseline's.
    """

    descriptions: list[str]
    rows: list[tuple[str, str]]
    prompts: list[tuple[str, str]]


def design(study: Study, sent: Mapping[str, Mapping[str, Mapping[str, object]]]) -> Design:
    """Read the design of a study from what was played.

    ``sent`` holds the parameters that models were asked with, by spec hash and side.
    """
    found = load_each({"descriptions": DESCRIPTIONS, "prompts": PROMPTS}, study.db)
    specs = {name for group in study.played for name in group.trials["spec_hash"]}
    prompts = found["prompts"]
    own = prompts.loc[prompts["spec_hash"].isin(specs), ["variant", "prompt"]]
    texts = dict(own.itertuples(index=False))
    shown = [name for name in dict.fromkeys(g.setting for g in study.played) if name in texts]
    baseline = texts.get(BASELINE)
    levels = levels_of(study.played, study.order)
    factors = {name: levels[name] for name in levels if name != "model"}
    drivers = list(dict.fromkeys(group.label for group in study.played))
    driven = {name for group in study.played for name in group.trials["condition"]}
    parameters = dict.fromkeys(
        f"{group.label}: " + ", ".join(f"{name} = {value}" for name, value in asked.items())
        for group in study.played
        for asked in sent.get(group.spec_hash or "", {}).values()
        if asked
    )
    rows = {"drivers": drivers, "parameters": parameters, **factors, "conditions": sorted(driven)}
    trials = sum(len(group.trials) for group in study.played)
    return Design(
        list(found["descriptions"]["description"])
        if study.source is None
        else [study.source.file.description] * bool(study.source.file.description),
        [
            *((name, ", ".join(values)) for name, values in rows.items() if values),
            ("trials", str(trials)),
        ],
        [
            (f"{title_of(name)}: first prompt", texts[name])
            if baseline is None or name == BASELINE
            else (f"{title_of(name)}: against the baseline", _changes(baseline, texts[name]))
            for name in shown
        ],
    )


def _changes(baseline: str, prompt: str) -> str:
    """The lines that were taken out (-) and put in (+)."""
    lines = unified_diff(baseline.splitlines(), prompt.splitlines(), lineterm="", n=0)
    return "\n".join(line for line in lines if not line.startswith(("---", "+++", "@@")))
