"""A prompt block from outside with two variants, from the sweep to the explorer."""

from __future__ import annotations

import json
import re

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner.prompts.blocks import Block
from merge_runner.run.plan import make_plan
from tests.support.harness import how_to, plugin

VARIANTS = ("--variants", "baseline,A1,A8,A9", "--reps", 1, "--conditions", "L_4_0,N_0_0")
WARNING = "Mind the speed of the other car: at "


@pytest.fixture(scope="module")
def played(study):
    installed = plugin(study.folder / "installed", how_to("add-a-prompt-block"))
    done = study.run("sweep", "baseline", *VARIANTS, **installed)
    assert done.code == 0, done.err
    return installed


def pages_of(folder):
    return "".join(
        page.read_text() for page in folder.rglob("*") if page.suffix in {".html", ".js", ".json"}
    )


def test_a_block_is_in_the_variants_that_add_it_and_changes_no_other(study, played):
    with duckdb.connect(str(study.folder / "results/merge.duckdb"), read_only=True) as connection:
        prompts = connection.execute(
            "SELECT variant, distance_to, prompt FROM trials JOIN (SELECT *, "
            "contains(prompt, 'Road type: merge') AS distance_to FROM decisions) "
            "USING (trial_id, spec_hash)"
        ).fetchall()
        hashes = dict(
            connection.execute("SELECT DISTINCT variant, spec_hash FROM trials").fetchall()
        )
    assert {variant for variant, *_ in prompts} == {"baseline", "A1", "A8", "A9"}
    for variant, before_the_merge, prompt in prompts:
        assert (WARNING in prompt) == (variant in {"A8", "A9"} and before_the_merge)
        assert ("History of" in prompt) == (variant not in {"A1", "A9"})
        assert prompt.split("\n\n")[-1].startswith("Output format:")
    # As this process has them, where the block is not installed.
    plan = make_plan("baseline", "emulator", 1, variants=("baseline", "A1"))
    own = {spec.variant: spec.spec_hash for spec in plan.trial_specs()}
    assert own.items() < hashes.items()
    assert len(set(hashes.values())) == 4


@pytest.mark.long
def test_it_is_in_every_command_that_reads(study, played):
    for command in (("audit",), ("view", "--export", "pages")):
        done = study.run(*command, **played)
        assert done.code == 0, f"{command}: {done.err}"
        assert "not replayed" not in done.out + done.err
    text = pages_of(study.folder / "pages")
    assert "with C6: warning of speed" in text
    assert "without C1: history and with C6: warning of speed" in text
    table = study.run("tables", "ablation-quantitative", "--format", "json", **played)
    (rows,) = (one["rows"] for one in json.loads(table.out)["tables"])
    assert "A8" in str(rows)


@pytest.mark.long
def test_where_it_is_not_installed_it_is_shown_by_name(study, played):
    for command in (("audit",), ("view", "--export", "bare")):
        done = study.run(*command)
        assert done.code == 0, f"{command}: {done.err}"
    text = pages_of(study.folder / "bare")
    assert "without C1: history and with C6" in text
    assert "with C6:" not in text
    asked = study.run("sweep", "baseline", *VARIANTS)
    assert asked.code == 2
    assert asked.err.startswith("error: unknown variant 'A8'; valid: baseline, A1, A2, ")


@pytest.mark.parametrize(
    ("templates", "told"),
    [
        (
            ("The time is {time}.", None),
            "unknown field on the road merge of the block 'x': 'time'; valid: vehicle_length, own_",
        ),
        (
            (None, "To go: {distance_to_merge}."),
            "road straight of the block 'x': 'distance_to_merge'",
        ),
        (("An open {", None), "a prompt block cannot be read"),
    ],
)
def test_a_block_that_cannot_be_written_is_refused(templates, told):
    with pytest.raises(UsageError, match=re.escape(told)):
        Block("x", *templates)


def test_a_block_with_no_place_is_told_before_anything_is_asked(study, tmp_path):
    source = (
        "from merge_runner.prompts.blocks import BLOCKS, VARIANTS, Block, Variant\n"
        'BLOCKS.register("C6", Block("x", "Text.", None, before="C9"))\n'
        'VARIANTS.register("A8", Variant(adds=frozenset({"C6"})))\n'
    )
    env = plugin(tmp_path / "installed", source)
    done = study.run("sweep", "baseline", "--variants", "A8", "--reps", 1, **env)
    assert done.code == 2
    assert done.err.startswith("error: unknown place of the prompt block C6, before 'C9'; valid: ")
    assert done.err.count("\n") == 1
