"""The entries of docs/models.md for local servers: what they send."""

import re
import tomllib

from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import read_models
from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/models.md").read_text()
BLOCKS = re.findall(r"```toml\n(.*?)\n```\n", PAGE, re.S)
ENTRIES = {name: entry for block in BLOCKS for name, entry in tomllib.loads(block).items()}
GRAMMAR = tomllib.loads((PROJECT / "experiments/models.toml").read_text())["smollm2"]["parameters"][
    "grammar"
]
PATTERN = ENTRIES["held-by-schema"]["parameters"]["response_format"]["json_schema"]["schema"][
    "pattern"
]
SCHEMA = {"type": "string", "pattern": PATTERN}


SENT = {
    "qwen3": {"model": "qwen3:8b", "max_tokens": 4000, "temperature": 1.0},
    "held-by-grammar": {"grammar": GRAMMAR},
    "held-by-schema": {
        "response_format": {
            "type": "json_schema",
            "json_schema": {"name": "reply", "schema": SCHEMA},
        }
    },
    "my-model": {"model": "qwen3-32b", "temperature": 0.7, "top_p": 0.95},
    "my-azure-o3": {"model": "my-deployment", "max_completion_tokens": 16000},
    "llama-70b": {
        "model": "meta-llama/llama-3.3-70b-instruct",
        "provider": {"order": ["deepinfra"], "allow_fallbacks": False},
    },
}


def test_the_entries_of_the_page_send_what_the_page_says(tmp_path):
    (tmp_path / "models.toml").write_text("\n".join(BLOCKS))
    entries = read_models(tmp_path / "models.toml")
    assert entries.keys() == SENT.keys()
    for name, entry in entries.items():
        body = FORMATS[entry.format].request(entry, "prompt").body
        assert SENT[name].items() <= body.items()
