"""Files and options that are wrong, of tests/cases/bad_configuration.toml."""

from tests.support.cases import table

CASES = table("bad_configuration")
MODEL = {"provider": '"local"', "format": '"openai-chat"', "id": '"x"', "max_output_tokens": "10"}
BASELINE = "repetitions = { baseline = 1 }"
NO_TEXT = {
    bytes(range(256)): "cannot be read: 'utf-8' codec can't decode",
    b"a = " + b"[" * 5000 + b"]" * 5000: "is no TOML file",
    b"a = 1" + b"0" * 5000: "is no TOML file: Exceeds the limit",
}


def with_line(line):
    """A model with one more line, or another one."""
    name, _, value = line.partition(" = ")
    return "\n".join(["[m]", *(f"{k} = {v}" for k, v in {**MODEL, name: value}.items())])
