from datetime import date

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.config import (
    PROVIDERS,
    ModelEntry,
    Price,
    endpoint_identity,
    key_status,
    normalised_url,
    resolve_endpoint,
)
from merge_runner.errors import UsageError
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import read_models, shutdown_notes
from merge_runner.study.file import read_study
from tests.support.harness import PROJECT

REGISTRY = PROJECT / "experiments/models.toml"
KEYS = {f"{name}_API_KEY": "k" for name in ("OPENAI", "GEMINI", "ANTHROPIC", "OPENROUTER")}


def entry(provider="openai", **changes):
    given = {"provider": provider, "format": "openai-chat", "id": "m", "max_output_tokens": 10}
    return ModelEntry(**{**given, **changes})


# What stands in the cache keys: a change here orphans every recording.
@pytest.mark.parametrize(
    ("provider", "base_url", "env", "identity"),
    [
        ("openai", None, {}, "openai"),
        ("openai", "https://api.openai.com/v1", {}, "openai"),
        ("openai", "HTTPS://API.OpenAI.com:443/v1/", {}, "openai"),
        ("openai", None, {"OPENAI_BASE_URL": "https://api.openai.com/v1/"}, "openai"),
        ("openai", None, {"OPENAI_BASE_URL": ""}, "openai"),
        ("openai", None, {"OPENAI_BASE_URL": "http://Proxy:80/v1/"}, "http://proxy/v1"),
        ("openai", "https://a.openai.azure.com/v1/", {}, "https://a.openai.azure.com/v1"),
        # The entry says more precisely than the environment which server is meant.
        ("openai", "http://a/v1", {"OPENAI_BASE_URL": "http://b/v1"}, "http://a/v1"),
        ("openai", "http://api.openai.com/v1", {}, "http://api.openai.com/v1"),
        ("openai", "https://api.openai.com/v2", {}, "https://api.openai.com/v2"),
        ("openai", None, {"GOOGLE_GEMINI_BASE_URL": "http://b"}, "openai"),
        ("gemini", None, {}, "gemini"),
        ("gemini", None, {"GOOGLE_GEMINI_BASE_URL": "http://b"}, "http://b"),
        ("anthropic", None, {}, "anthropic"),
        ("anthropic", None, {"ANTHROPIC_BASE_URL": "http://b"}, "http://b"),
        ("openrouter", None, {}, "openrouter"),
        ("local", None, {}, "local"),
        ("local", None, {"LOCAL_BASE_URL": "http://gpu:8001/v1"}, "http://gpu:8001/v1"),
        ("emulator", None, {}, "emulator"),
        ("emulator", None, {"EMULATOR_BASE_URL": "http://127.0.0.1:12345/v1"}, "emulator"),
    ],
)
def test_the_identity_of_an_endpoint(provider, base_url, env, identity):
    model = entry(provider, base_url=base_url)
    assert endpoint_identity(model, env) == identity
    assert resolve_endpoint("m", model, {**KEYS, **env}).identity == identity


def test_an_endpoint_is_reached_at_its_normalised_base_url():
    env = {**KEYS, "OPENAI_BASE_URL": "HTTP://Proxy:8080/v1/"}
    endpoint = resolve_endpoint("m", entry(), env)
    assert endpoint.base_url == "http://proxy:8080/v1"
    assert resolve_endpoint("m", entry(), KEYS).base_url == "https://api.openai.com/v1"
    assert endpoint.provider == "openai"


@pytest.mark.parametrize(
    ("url", "normal"),
    [
        ("https://example.com", "https://example.com"),
        ("https://example.com/", "https://example.com"),
        ("HTTPS://EXAMPLE.com/V1", "https://example.com/V1"),
        ("https://example.com:443/v1/", "https://example.com/v1"),
        ("http://example.com:80", "http://example.com"),
        ("http://example.com:443", "http://example.com:443"),
        ("https://example.com:80", "https://example.com:80"),
        ("http://localhost:8000/v1//", "http://localhost:8000/v1"),
        ("  http://localhost:8000/v1\n", "http://localhost:8000/v1"),
        ("http://[::1]:8000/v1", "http://[::1]:8000/v1"),
        ("http://[::1]:80", "http://[::1]"),
        ("http://[2001:DB8::1]/", "http://[2001:db8::1]"),
    ],
)
def test_a_base_url_has_one_spelling(url, normal):
    assert normalised_url(url) == normal


@pytest.mark.parametrize(
    "url",
    [
        "",
        "example.com/v1",
        "localhost:8000",
        "ftp://example.com",
        "file:///etc/passwd",
        "http://",
        "http:///v1",
        "https://:443",
        "http://example.com:port",
        "http://example.com:99999",
        "http://[::1",
    ],
)
def test_what_is_no_base_url_is_refused(url):
    with pytest.raises(UsageError):
        normalised_url(url)


@pytest.mark.parametrize("at", ["{}", "{}/v1", "http://{}:port", "https://h/{} ", "https://h/v1/{}",
                                "https://{}/v1", "https://u:{}@h", "https://h?k={}"])  # fmt: skip
def test_a_key_that_was_pasted_into_a_base_url_is_refused_and_not_shown(at):
    key = "sk-Proj-0123456789"
    env = {"OPENAI_API_KEY": key, "OPENAI_BASE_URL": at.format(key)}
    with pytest.raises(UsageError) as refused:
        resolve_endpoint("x", entry(), env)
    assert key.lower()[3:] not in str(refused.value).lower()
    assert "base URL" in str(refused.value) or "OPENAI_BASE_URL" in str(refused.value)


labels = st.text("abcXYZ09-", min_size=1, max_size=8)
paths = st.lists(labels, max_size=3)
ports = st.none() | st.integers(1, 65535)


@settings(deadline=None)
@given(st.sampled_from(["http", "https"]), labels, ports, paths, st.booleans())
def test_the_laws_of_normalisation(scheme, host, port, path, slash):
    address = host if port is None else f"{host}:{port}"
    tail = "".join(f"/{part}" for part in path)
    normal = normalised_url(f"{scheme}://{address}{tail}{'/' * slash}")
    assert normalised_url(normal) == normal
    assert normal == normalised_url(f"{scheme.upper()}://{address.upper()}{tail}/")
    assert normal.endswith(tail)
    assert normal.startswith(f"{scheme}://{host.lower()}")
    default = {"http": 80, "https": 443}[scheme]
    same_port = normalised_url(f"{scheme}://{host}:{port or default}{tail}")
    assert normal == same_port
    other_port = normalised_url(f"{scheme}://{host}:{(port or default) % 65535 + 1}{tail}")
    assert normal != other_port


@pytest.mark.parametrize(
    ("model", "env", "headers"),
    [
        (entry("openai"), {"OPENAI_API_KEY": "k"}, {"authorization": "Bearer k"}),
        (entry("openrouter"), {"OPENROUTER_API_KEY": "k"}, {"authorization": "Bearer k"}),
        (entry("anthropic"), {"ANTHROPIC_API_KEY": "k"}, {"x-api-key": "k"}),
        (entry("gemini"), {"GEMINI_API_KEY": "k"}, {"x-goog-api-key": "k"}),
        (entry("gemini"), {"GOOGLE_API_KEY": "g"}, {"x-goog-api-key": "g"}),
        # As the official SDK does.
        (
            entry("gemini"),
            {"GEMINI_API_KEY": "k", "GOOGLE_API_KEY": "g"},
            {"x-goog-api-key": "g"},
        ),
        (
            entry("gemini"),
            {"GEMINI_API_KEY": "k", "GOOGLE_API_KEY": ""},
            {"x-goog-api-key": "k"},
        ),
        # Azure.
        (
            entry("openai", key_env="AZURE_OPENAI_API_KEY", auth="api-key"),
            {"OPENAI_API_KEY": "k", "AZURE_OPENAI_API_KEY": "a"},
            {"api-key": "a"},
        ),
        (
            entry("openai", key_env="MY_KEY"),
            {"OPENAI_API_KEY": "k", "MY_KEY": "m"},
            {"authorization": "Bearer m"},
        ),
        (entry("local"), {}, {}),
        (entry("local"), {"LOCAL_API_KEY": "k"}, {"authorization": "Bearer k"}),
        (entry("emulator"), {"OPENAI_API_KEY": "k"}, {}),
    ],
)
def test_the_header_that_carries_the_key(model, env, headers):
    assert resolve_endpoint("m", model, env).auth_headers == headers
    needed = model.provider not in ("local", "emulator")
    assert key_status(model, env) == ("set" if needed else "not needed")


@pytest.mark.parametrize(
    ("model", "env", "named"),
    [
        (entry("openai"), {}, ["OPENAI_API_KEY"]),
        (entry("openai"), {"OPENAI_API_KEY": ""}, ["OPENAI_API_KEY"]),
        (entry("openai"), {"GEMINI_API_KEY": "k"}, ["OPENAI_API_KEY"]),
        (entry("gemini"), {}, ["GOOGLE_API_KEY", "GEMINI_API_KEY"]),
        (entry("anthropic"), {}, ["ANTHROPIC_API_KEY"]),
        (entry("openrouter"), {}, ["OPENROUTER_API_KEY"]),
        # The entry's own variable is the only one that counts.
        (entry("openai", key_env="MY_KEY"), {"OPENAI_API_KEY": "k"}, ["MY_KEY"]),
    ],
)
def test_a_missing_key_is_an_error_that_names_its_variable(model, env, named):
    with pytest.raises(UsageError) as caught:
        resolve_endpoint("my-model", model, env)
    assert all(name in str(caught.value) for name in [*named, "my-model"])
    assert "\n" not in str(caught.value)
    assert key_status(model, env) == "missing"


def test_the_identity_needs_no_key():
    assert endpoint_identity(entry("openai"), {}) == "openai"


def test_a_key_is_not_shown():
    endpoint = resolve_endpoint("m", entry("openai"), {"OPENAI_API_KEY": "secret"})
    assert "secret" not in f"{endpoint!r} {endpoint}"


def test_an_unknown_provider_is_an_error_that_names_the_known_ones():
    with pytest.raises(UsageError) as caught:
        resolve_endpoint("m", entry("opnai"), {})
    assert all(name in str(caught.value) for name in ["opnai", *PROVIDERS])


def test_the_registry_that_we_ship_is_valid():
    models = read_models(REGISTRY)
    assert {"o3", "gemini-2.5-pro", "emulator", "local"} <= models.keys()
    assert any(model.provider == "anthropic" for model in models.values())
    for name, model in models.items():
        assert model.provider in PROVIDERS, name
        endpoint = resolve_endpoint(name, model, KEYS)
        # At their default URLs, so that a recording fits the key of everybody's registry.
        assert endpoint.identity == model.provider, name
        assert FORMATS[model.format].request(model, "prompt").body, name


def test_the_models_of_the_paper_are_those_it_names():
    models = read_models(REGISTRY)
    assert (models["o3"].provider, models["o3"].id) == ("openai", "o3-2025-04-16")
    assert models["o3"].shutdown.isoformat() == "2026-12-11"
    gemini = models["gemini-2.5-pro"]
    assert (gemini.provider, gemini.id) == ("gemini", "gemini-2.5-pro")
    assert gemini.shutdown.isoformat() == "2026-12-01"
    assert gemini.parameters["temperature"] == 1.0
    assert "temperature" not in models["o3"].parameters


def test_every_model_that_closes_has_a_successor_in_the_registry():
    models = read_models(REGISTRY)
    successors = {name: model.successor for name, model in models.items() if model.shutdown}
    assert successors == {"o3": "gpt-5.6-sol", "gemini-2.5-pro": "gemini-3.8-flash"}
    assert {*successors.values()} <= models.keys()


@pytest.mark.parametrize(
    ("today", "note"),
    [
        ("2026-11-10", "note: m closes in 31 days, on 2026-12-11; its successor is n"),
        ("2026-11-11", "WARNING: m closes in 30 days, on 2026-12-11: record it now (docs/"),
        ("2026-12-10", "WARNING: m closes in 1 day, on 2026-12-11: record it now (docs/"),
        ("2026-12-11", "WARNING: m closed on 2026-12-11: only a recording answers for it"),
        ("2027-01-01", "WARNING: m closed on 2026-12-11: only a recording answers for it"),
    ],
)
def test_a_warning_comes_thirty_days_before_a_model_closes_and_from_then_on(today, note):
    closing = {"m": entry(shutdown="2026-12-11", successor="n"), "other": entry()}
    (said,) = shutdown_notes(closing, date.fromisoformat(today))
    assert said.startswith(note)
    assert said.endswith("; its successor is n")
    assert not [*shutdown_notes({"other": entry()}, date.fromisoformat(today))]


VALID = """
[m]
provider = "local"
format = "openai-chat"
id = "x"
max_output_tokens = 10
"""


@pytest.mark.parametrize(
    ("more", "unknown", "owner"),
    [
        ("maximum_rpm = 5", "maximum_rpm", ModelEntry),
        ("temperature = 1.0", "temperature", ModelEntry),
        ('price = { input = 1, output = 2, source = "s", cached = 1 }', "cached", Price),
    ],
)
def test_an_unknown_key_of_the_registry_is_one_line_that_names_the_valid_ones(
    tmp_path, more, unknown, owner
):
    file = tmp_path / "models.toml"
    file.write_text(VALID)
    assert read_models(file)["m"].id == "x"
    file.write_text(VALID + more)
    with pytest.raises(UsageError) as caught:
        read_models(file)
    text = str(caught.value)
    assert "\n" not in text
    assert f"{unknown}'; valid: {', '.join(owner.model_fields)}" in text
    assert str(file) in text
    assert "[m]" in text


@pytest.mark.parametrize(
    ("more", "unknown", "valid"),
    [
        ("repetition = 5", "repetition", ["repetitions", "conditions", "scenario", "description"]),
        ("[scenario]\nhorizont_s = 5", "horizont_s", ["horizon_s", "collision_rule", "fallback"]),
    ],
)
def test_an_unknown_key_of_a_sweep_is_one_line_that_names_the_valid_ones(
    tmp_path, more, unknown, valid
):
    file = tmp_path / "mine.toml"
    file.write_text(f"repetitions = {{ baseline = 2 }}\n{more}\n")
    with pytest.raises(UsageError) as caught:
        read_study(str(file))
    text = str(caught.value)
    assert "\n" not in text
    assert all(name in text for name in [unknown, *valid])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[m", "models.toml"),
        ("[m]\nprovider = 1", "provider"),
        ("m = 1", "[m]"),
        (VALID.replace("openai-chat", "openai-cat"), "openai-responses"),
        (VALID.replace("10", "0"), "max_output_tokens"),
        (VALID + "deadline_s = inf", "deadline_s"),
    ],
)
def test_a_registry_that_is_wrong_is_one_line_that_says_where(tmp_path, text, named):
    file = tmp_path / "models.toml"
    file.write_text(text)
    with pytest.raises(UsageError) as caught:
        read_models(file)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_registry_that_is_missing_is_an_error(tmp_path):
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_models(tmp_path / "models.toml")


def test_toml_files_with_the_byte_order_mark_of_windows_editors_are_read(tmp_path):
    entry = '[m]\nprovider = "local"\nformat = "openai-chat"\nid = "x"\nmax_output_tokens = 10\n'
    models = tmp_path / "models.toml"
    models.write_text(entry, encoding="utf-8-sig")
    assert read_models(models)["m"].id == "x"
    study = tmp_path / "study.toml"
    study.write_text("[repetitions]\nbaseline = 2\n", encoding="utf-8-sig")
    assert read_study(str(study)).text == "[repetitions]\nbaseline = 2\n"
