"""The entries of docs/how-to/local-models.md: what they send, and how such replies are read."""

from __future__ import annotations

import json
import re
import tomllib

from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import read_models
from merge_runner.prompts.parse import parse_reply
from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/how-to/local-models.md").read_text()
BLOCKS = re.findall(r"```toml\n(.*?)\n```\n", PAGE, re.S)
ENTRIES = {name: entry for block in BLOCKS for name, entry in tomllib.loads(block).items()}
GRAMMAR = tomllib.loads((PROJECT / "experiments/models.toml").read_text())["smollm2"]["parameters"][
    "grammar"
]
PATTERN = ENTRIES["held-by-json"]["parameters"]["response_format"]["schema"]["pattern"]
SCHEMA = {"type": "string", "pattern": PATTERN}
# What SmolLM2-135M-Instruct said, held by the grammar (to llama.cpp's server) and by the schema (to
# llama-cpp-python).
BY_GRAMMAR = (
    "Y\nYou are driving a car through a merge. You are not allowed to turn around. You are a human "
    "driver who has not yet diverged from the other car. \n"
    "```python\n[0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n```"
)
BY_SCHEMA = (
    '"Y: The situation in a merge is no longer possible. Be careful of your decisions, and avoid '
    "merging to the other car on the road you didn't want. Always be conservative when it comes to "
    "planning and reducing your speed to minimize risks. [-1, -0.25, -0.36, -0.48, -0.7, -1, 0.92, "
    '1, -1, -0.84, 0, 1, -0.23, 0, 1, 0, 0.15, 0, -1, 0]"'
)


SENT = {
    "qwen3": {"model": "qwen3:8b", "max_tokens": 4000, "temperature": 1.0},
    "held-by-grammar": {"grammar": GRAMMAR},
    "held-by-vllm": {"structured_outputs": {"grammar": GRAMMAR}},
    "held-by-schema": {
        "response_format": {
            "type": "json_schema",
            "json_schema": {"name": "reply", "schema": SCHEMA},
        }
    },
    "held-by-json": {"response_format": {"type": "json_object", "schema": SCHEMA}},
}


def test_the_entries_of_the_page_send_what_the_page_says(tmp_path):
    (tmp_path / "models.toml").write_text("\n".join(BLOCKS))
    entries = read_models(tmp_path / "models.toml")
    assert entries.keys() == SENT.keys()
    for name, entry in entries.items():
        body = FORMATS[entry.format].request(entry, "prompt").body
        assert SENT[name].items() <= body.items()


def test_replies_of_both_forms_are_read_with_letter_reason_and_plan():
    by_grammar, by_schema = parse_reply(BY_GRAMMAR, 20), parse_reply(BY_SCHEMA, 20)
    assert re.fullmatch(PATTERN, json.loads(BY_SCHEMA))
    assert (by_grammar.tactical, by_schema.tactical) == ("Y", "Y")
    assert by_grammar.plan == (0.0, 0.0, *[1.0] * 18)
    assert by_schema.plan[:3] == (-1.0, -0.25, -0.36)
    assert by_grammar.rationale.startswith("You are driving a car through a merge.")
    assert by_schema.rationale.startswith("The situation in a merge is no longer possible.")


def test_of_an_object_letter_and_plan_are_read():
    reply = json.dumps({"decision": "M", "rationale": "I am ahead.", "plan": [0.5] * 20})
    parsed = parse_reply(reply, 20)
    assert parsed.plan == (0.5,) * 20
    assert parsed.tactical == "M"
