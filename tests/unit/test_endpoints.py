import re
from datetime import date

import pytest

from merge_runner.errors import UsageError
from merge_runner.llm.endpoint_state import if_nobody
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.http import url_of
from merge_runner.llm.models import read_models, shutdown_notes, with_parameter
from merge_runner.providers import (
    PROVIDERS,
    ModelEntry,
    endpoint_identity,
    key_status,
    normalised_url,
    resolve_endpoint,
)
from tests.support.cases import table
from tests.support.harness import PROJECT

REGISTRY = PROJECT / "experiments/models.toml"
KEYS = {f"{name}_API_KEY": "k" for name in ("OPENAI", "GEMINI", "ANTHROPIC", "OPENROUTER")}
CASES = table("endpoints")


def entry(provider="openai", **changes):
    given = {"provider": provider, "format": "openai-chat", "id": "m", "max_output_tokens": 10}
    return ModelEntry(**{**given, **changes})


@pytest.mark.parametrize(("provider", "base_url", "env", "identity"), CASES["identity"])
def test_the_identity_of_an_endpoint(provider, base_url, env, identity):
    model = entry(provider, base_url=base_url or None)
    assert endpoint_identity(model, env) == identity
    assert resolve_endpoint("m", model, {**KEYS, **env}).identity == identity


def test_an_endpoint_is_reached_at_its_normalised_base_url():
    endpoint = resolve_endpoint("m", entry(), {**KEYS, "OPENAI_BASE_URL": "HTTP://Proxy:8080/v1/"})
    assert (endpoint.provider, endpoint.base_url) == ("openai", "http://proxy:8080/v1")
    assert resolve_endpoint("m", entry(), KEYS).base_url == "https://api.openai.com/v1"


@pytest.mark.parametrize(("url", "normal"), CASES["spelling"].items())
def test_a_base_url_has_one_spelling(url, normal):
    assert normalised_url(url) == normalised_url(normal) == normal


@pytest.mark.parametrize("url", CASES["refused"])
def test_what_is_no_base_url_is_refused(url):
    with pytest.raises(UsageError):
        normalised_url(url)


@pytest.mark.parametrize("at", CASES["pasted"])
def test_a_key_that_was_pasted_into_a_base_url_is_refused_and_not_shown(at):
    key = "sk-Proj-0123456789"
    env = {"OPENAI_API_KEY": key, "OPENAI_BASE_URL": at.format(key)}
    with pytest.raises(UsageError) as refused:
        resolve_endpoint("x", entry(), env)
    assert key.lower()[3:] not in str(refused.value).lower()
    assert "base URL" in str(refused.value) or "OPENAI_BASE_URL" in str(refused.value)


@pytest.mark.parametrize(("provider", "more", "env", "headers"), CASES["header"])
def test_the_header_that_carries_the_key(provider, more, env, headers):
    model = entry(provider, **more)
    assert resolve_endpoint("m", model, env).auth_headers == headers
    needed = model.provider not in ("local", "emulator")
    assert key_status(model, env) == ("set" if needed else "not needed")


@pytest.mark.parametrize(("provider", "more", "env", "named"), CASES["missing"])
def test_a_missing_key_is_an_error_that_names_its_variable(provider, more, env, named):
    model = entry(provider, **more)
    with pytest.raises(UsageError) as caught:
        resolve_endpoint("my-model", model, env)
    assert all(name in str(caught.value) for name in [*named, "my-model"])
    assert "\n" not in str(caught.value)
    assert key_status(model, env) == "missing"


def test_a_key_is_not_shown():
    endpoint = resolve_endpoint("m", entry("openai"), {"OPENAI_API_KEY": "secret"})
    assert "secret" not in f"{endpoint!r} {endpoint}"


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


def test_the_models_of_the_paper_are_those_it_names_and_have_successors():
    models = read_models(REGISTRY)
    o3, gemini = models["o3"], models["gemini-2.5-pro"]
    assert (o3.provider, o3.id, str(o3.shutdown)) == ("openai", "o3-2025-04-16", "2026-12-11")
    assert (gemini.provider, gemini.id) == ("gemini", "gemini-2.5-pro")
    assert str(gemini.shutdown) == "2026-12-01"
    assert (o3.parameters.get("temperature"), gemini.parameters["temperature"]) == (None, 1.0)
    successors = {name: model.successor for name, model in models.items() if model.shutdown}
    assert successors == {"o3": "gpt-5.6-sol", "gemini-2.5-pro": "gemini-3.8-flash"}
    assert {*successors.values()} <= models.keys()


@pytest.mark.parametrize(("today", "note"), CASES["closing"].items())
def test_a_warning_comes_thirty_days_before_a_model_closes_and_from_then_on(today, note):
    closing = {"m": entry(shutdown="2026-12-11", successor="n"), "other": entry()}
    (said,) = shutdown_notes(closing, date.fromisoformat(today))
    assert said.startswith(note)
    assert said.endswith("; its successor is n")
    assert not [*shutdown_notes({"other": entry()}, date.fromisoformat(today))]


def test_an_entry_names_the_file_that_it_was_read_from_with_whatever_parameters(tmp_path):
    path = tmp_path / "models.toml"
    path.write_text(
        '[mine]\nprovider = "openai"\nformat = "openai-chat"\nid = "m"\nmax_output_tokens = 10\n'
        'base_url = "http://gpu/v1"\nkey_env = "MY_KEY"\n'
    )
    mine, place = read_models(path)["mine"], f"[mine] in {path}"
    capped = with_parameter("mine", mine, "max_output_tokens", 5)
    warm = with_parameter("mine", capped, "temperature", 1.0).model_copy(update={"id": "n"})
    assert warm.place == place
    assert with_parameter("mine", mine, "max_output_tokens", 10) == mine
    assert if_nobody(warm).startswith(f"check the network, or correct `base_url` of {place}; ")
    endpoint = resolve_endpoint("mine", warm, {"MY_KEY": "k"})
    with pytest.raises(UsageError, match=f"'m' can be no path: correct {re.escape(place)}"):
        url_of(endpoint.base_url, "m", endpoint.place)


def test_a_registry_that_is_missing_is_an_error(tmp_path):
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_models(tmp_path / "models.toml")
