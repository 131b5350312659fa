"""Whatever is wrong with a file or an option: one line that says what is valid, and exit code 2."""

from __future__ import annotations

import sys

import pytest

from merge_runner.config import PROVIDERS, ModelEntry, ScenarioConfig
from merge_runner.prompts.blocks import VARIANTS
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.file import StudyFile
from merge_runner_analysis.commands import main

MODEL = {
    "provider": '"local"',
    "format": '"openai-chat"',
    "id": '"x"',
    "max_output_tokens": "10",
}
BINARY = bytes(range(256))
DEEP = b"a = " + b"[" * 5000 + b"]" * 5000
MODEL_KEYS = ", ".join(ModelEntry.model_fields)


def model(**changes):
    lines = [f"{name} = {value}" for name, value in {**MODEL, **changes}.items()]
    return "\n".join(["[m]", *lines]).encode()


def sweep(text="", repetitions="{ baseline = 1 }"):
    return f"repetitions = {repetitions}\n{text}\n".encode()


def scenario(text):
    return sweep(f"[scenario]\n{text}")


@pytest.fixture
def program(tmp_path, monkeypatch, capsys):
    """Runs the command line in this process: a start of its own takes too long for each row."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_bytes(model())
    (tmp_path / "experiments/mine.toml").write_bytes(sweep())

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["merge-runner", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        shown = capsys.readouterr()
        return ended.value.code, shown.out, shown.err

    return run


def refused(program, *arguments):
    """The one line on standard error."""
    code, out, err = program(*arguments)
    assert (code, out) == (2, ""), err
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert line.isprintable()
    return line


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (model(maximum="5"), f"unknown key 'maximum'; valid: {MODEL_KEYS}"),
        (model(**{'"a\\nb\\u001b"': "5"}), "unknown key 'a\\nb"),
        (
            model(price='{ input = 1, output = 2, source = "s", x = 1 }'),
            "valid: input, cached_input",
        ),
        (model(provider="3"), "provider: Input should be a valid string"),
        (model(provider='"opnai"'), f"unknown provider 'opnai'; valid: {', '.join(PROVIDERS)}"),
        (
            model(format='"openai"'),
            "[m]: unknown wire format 'openai'; valid: openai-chat, openai-responses, gemini,",
        ),
        (model(rpm="-5"), "rpm: Input should be greater than 0"),
        (model(tpm="-5"), "tpm: Input should be greater than 0"),
        (model(rpm="0"), "rpm: Input should be greater than 0"),
        (model(rpm='"5"'), "rpm: Input should be a valid integer"),
        (model(rpm="true"), "rpm: Input should be a valid integer"),
        (model(rpm="1.5"), "rpm: Input should be a valid integer"),
        (model(rpm="nan"), "rpm: Input should be a valid integer"),
        (model(max_output_tokens="-1"), "max_output_tokens: Input should be greater than 0"),
        (model(timeout_s="nan"), "timeout_s: Input should be a finite number"),
        (model(deadline_s="inf"), "deadline_s: Input should be a finite number"),
        (model(deadline_s='"5"'), "deadline_s: Input should be a valid number"),
        (model(timeout_s="true"), "timeout_s: Input should be a valid number"),
        (model(price='"cheap"'), "Input should be 'free' or 'genai-prices'"),
        (model(price='{ input = -1, output = 1, source = "s" }'), "greater than or equal to 0"),
        (model(price='{ input = inf, output = 1, source = "s" }'), "a finite number"),
        (
            model(parameters="{ temperature = nan }"),
            "parameters.temperature.float: Input should be a finite number",
        ),
        (model(parameters="{ a = [{ b = inf }] }"), "b.float: Input should be a finite number"),
        (model(parameters="{ a = 2026-01-01 }"), "parameters.a: input was not a valid JSON value"),
        (
            model(applied_defaults="{ a = -inf }"),
            "applied_defaults.a.float: Input should be a finite number",
        ),
        (model(cap_field='"x"'), "'max_completion_tokens' or 'max_tokens'"),
        (model(auth='"x"'), "'bearer' or 'api-key'"),
        (model(shutdown='"soon"'), "shutdown: Input should be a valid date"),
        (model(aliases='"x"'), "aliases: Input should be a valid tuple"),
        (model(base_url='"nope"'), "must begin with http:// or https://"),
        (model(base_url='"http://user:word@host/v1"'), "is no base URL"),
        (b"m = 1", "[m]: Input should be a valid dictionary"),
        (b'["a\\nb"]\nx = 1', "[a?b]: provider: Field required"),
        (b"[m", "is no TOML file: Expected ']'"),
        (b"a = 1\na = 2", "is no TOML file"),
        (b"a = 1" + b"0" * 5000, "is no TOML file: Exceeds the limit"),
        (BINARY, "cannot be read: 'utf-8' codec can't decode"),
        (b"\0\0\0", "is no TOML file"),
        (DEEP, "is no TOML file"),
    ],
    ids=lambda value: str(value)[-60:],
)
def test_a_registry_that_is_wrong(program, tmp_path, content, says):
    (tmp_path / "experiments/models.toml").write_bytes(content)
    for command in (("models",), ("sweep", "mine", "--model", "constant")):
        line = refused(program, *command)
        assert says in line
        assert "experiments/models.toml" in line


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "repetitions: Field required"),
        (
            sweep("unknown = 1"),
            f"unknown key 'unknown'; valid: {', '.join(StudyFile.model_fields)}",
        ),
        (sweep("scenario = 3"), "scenario: Input should be a valid dictionary"),
        (sweep("conditions = 'N_0_0'"), "conditions: it should be a list of names"),
        (sweep("conditions = [1]"), "conditions: it should be a list of names"),
        (sweep("conditions = ['X']"), f"unknown condition 'X'; valid: {', '.join(CONDITIONS)}"),
        (
            sweep("conditions = [{ name = 'near', headway = 1.0 }]"),
            "unknown key 'conditions.near.headway'; valid: projected_headway_m, relative_",
        ),
        (sweep("conditions = []"), f"no condition is left; valid: {', '.join(CONDITIONS)}"),
        (sweep(repetitions="'3'"), "repetitions: Input should be a valid dictionary"),
        (sweep(repetitions="0"), "repetitions.every prompt: Input should be greater than 0"),
        (sweep(repetitions="{}"), "has no variant; valid: baseline, A1"),
        (sweep(repetitions="{ Z = 1 }"), f"unknown variant 'Z'; valid: {', '.join(VARIANTS)}"),
        (sweep(repetitions="{ baseline = -1 }"), "repetitions.baseline: Input should be greater"),
        (
            sweep(repetitions="{ baseline = 1.5 }"),
            "repetitions.baseline: Input should be a valid int",
        ),
        (sweep(repetitions="{ baseline = 100001 }"), "less than or equal to 100000"),
        (
            scenario("horizn_s = 5"),
            f"'scenario.horizn_s'; valid: {', '.join(ScenarioConfig.model_fields)}",
        ),
        (scenario("horizon_s = nan"), "scenario.horizon_s: Input should be a finite number"),
        (scenario("horizon_s = inf"), "scenario.horizon_s: Input should be a finite number"),
        (scenario("horizon_s = -1"), "scenario.horizon_s: Input should be greater than 0"),
        (scenario("horizon_s = '4'"), "scenario.horizon_s: Input should be a valid number"),
        (scenario("horizon_s = 4.1"), "scenario: horizon_s = 4.1 s is no whole number of 0.2 s"),
        (scenario("horizon_s = 1e308"), "scenario: horizon_s = 1e+308 s is more than 100000 steps"),
        (
            scenario("vehicle_length_m = 1e308"),
            "vehicle_length_m: Input should be less than or equal",
        ),
        (scenario("vehicle_width_m = 101"), "less than or equal to 100"),
        (scenario("max_acceleration_mps2 = 1e308"), "less than or equal to 1000000"),
        (scenario("perception_left = { speed_sd_mps = 1e308 }"), "less than or equal to 1000000"),
        (scenario("perception_left = { position_sd_m = 1e308 }"), "less than or equal to 1000000"),
        (
            sweep(
                "conditions = [{ name = 'X', projected_headway_m = 0, relative_velocity_mps = 0, "
                "mean_speed_mps = 1e308 }]"
            ),
            "mean_speed_mps: Input should be less than or equal to 1000000",
        ),
        (scenario("step_s = 5e-324"), "is more than 100000 steps"),
        (scenario("prompt_rate_hz = 5e-324"), "is more than 100000 steps"),
        (scenario("prompt_rate_hz = 1e308"), "is no whole number"),
        (scenario("collision_rule = 'x'"), "'euclid2d', 'rectangle' or 'shared_lane'"),
        (BINARY, "cannot be read: 'utf-8'"),
        (DEEP, "is no TOML file"),
    ],
    ids=lambda value: str(value)[-60:],
)
def test_a_sweep_that_is_wrong(program, tmp_path, content, says):
    (tmp_path / "mine.toml").write_bytes(content)
    for name in ("mine.toml", str(tmp_path / "mine.toml")):
        assert says in refused(program, "sweep", name, "--model", "constant", "--dry-run")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["nope"],
            "unknown sweep 'nope'; valid: ablations, baseline, mine, reference (or a path)",
        ),
        ([""], "unknown sweep ''; valid: ablations, baseline, mine"),
        (["models"], "unknown sweep 'models'; valid: ablations, baseline, mine"),
        (["../mine"], "unknown sweep '../mine'; valid: ablations, baseline, mine"),
        (["a\nb\x1b"], "unknown sweep 'a\\nb\\x1b'; valid: ablations"),
        (["x" * 5000], "valid: ablations"),
        (["nowhere.toml"], "nowhere.toml cannot be read: No such file"),
        (["folder.toml"], "folder.toml cannot be read: Is a directory"),
        (["mine", "--model", "gpt9"], "unknown model 'gpt9'; valid: emulator, random, o3, "),
        (["mine", "--model", "m+gpt9"], "unknown model 'gpt9'; valid: emulator, random, o3, "),
        (["mine", "--conditions", "X"], f"unknown condition 'X'; valid: {', '.join(CONDITIONS)}"),
        (["mine", "--variants", "Z"], f"unknown variant 'Z'; valid: {', '.join(VARIANTS)}"),
        (["mine", "--reps", "-1"], "--reps is a whole number from 1"),
        (["mine", "--sample-set", "-1"], "--sample-set is a whole number from 0"),
        (["mine", "--db", "folder.toml"], "folder.toml"),
        (["mine", "--db", "binary"], "binary cannot be opened as a database"),
        (["mine", "--cache", "binary"], "the cache binary cannot be used"),
        (["mine", "--recording", "x.parquet"], "--recording goes with a replay"),
    ],
    ids=lambda value: str(value)[:60],
)
def test_an_option_that_is_wrong(program, tmp_path, arguments, says):
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "binary").write_bytes(BINARY * 100)
    chosen = [] if "--model" in arguments else ["--model", "constant"]
    assert says in refused(program, "sweep", *arguments, *chosen)


# Typer reports these itself: the usage, a hint and the error.
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["sweep", "mine", "--rpm", "-1"], "--rpm"),
        (["sweep", "mine", "--rpm", "nan"], "--rpm"),
        (["sweep", "mine", "--tpm", "0"], "--tpm"),
        (["sweep", "mine", "--max-cost", "-1"], "--max-cost"),
        (["sweep", "mine", "--reps", "x"], "--reps"),
        (["sweep", "mine", "--unknown"], "--unknown"),
        (["sql", "select 1", "--format", "xml"], "'text', 'csv', 'json'"),
        (["tables", "--format", "xml"], "'latex'"),
        (["emulate", "--port", "99999"], "--port"),
        (["unknown"], "unknown"),
    ],
    ids=str,
)
def test_what_typer_refuses_takes_a_few_lines_and_no_traceback(program, arguments, says):
    code, out, err = program(*arguments)
    assert (code, out) == (2, "")
    assert says in err
    assert "Traceback" not in err
    assert len(err.splitlines()) <= 4


@pytest.mark.parametrize(
    "content", [model(rpm="-5"), BINARY, DEEP], ids=["value", "binary", "deep"]
)
async def test_the_program_says_one_line_and_with_debug_a_traceback(
    merge_runner, tmp_path, content
):
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/models.toml").write_bytes(content)
    plain = await merge_runner("models")
    assert (plain.code, plain.out, len(plain.err.splitlines())) == (2, "", 1)
    assert plain.err.startswith("error: experiments/models.toml")
    debug = await merge_runner("models", "--debug")
    assert debug.code != 0
    assert "Traceback" in debug.err
    assert plain.err.removeprefix("error: ").strip() in debug.err


def test_what_is_right_is_taken(program, tmp_path):
    """Or else the tests above would show nothing."""
    (tmp_path / "experiments/models.toml").write_bytes(
        model(rpm="5", timeout_s="7", price='{ input = 1, output = 2.5, source = "s" }')
    )
    code, out, err = program("sweep", "mine", "--model", "m", "--dry-run")
    assert (code, err) == (0, "")
    assert "Nothing was sent." in out
