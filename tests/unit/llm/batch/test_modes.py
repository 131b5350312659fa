"""Which models have a batch mode, and at what price."""

import pytest

from merge_runner.llm.batch.providers import SERVICES, batch_terms
from merge_runner.llm.formats import FORMATS
from merge_runner.llm.models import load_models
from merge_runner.providers import PROVIDERS, BatchTerms
from tests.support.batch_fixtures import entry_of

OWN = BatchTerms(price_factor=0.6, source="contract, 2026-11")


def test_the_shipped_models_of_four_providers_have_a_batch_mode_at_half_price():
    terms = {name: batch_terms(entry) for name, entry in load_models().items()}
    without = {name for name, each in terms.items() if each is None}
    assert without == {"local", "smollm2", "smollm2-free"}
    assert {each.price_factor for each in terms.values() if each} == {0.5}
    assert SERVICES.keys() == FORMATS.keys()


def test_an_entry_may_have_terms_of_its_own_or_no_batch_mode():
    assert batch_terms(entry_of("openai-chat", "openrouter")) is None
    assert batch_terms(entry_of("openai-chat", "openrouter", batch=OWN)) == OWN
    assert batch_terms(entry_of("openai-chat", batch="none")) is None
    # One deployment's path, which no batch can name.
    assert batch_terms(entry_of("openai-chat", path="/deployments/x/chat/completions")) is None


@pytest.mark.parametrize("form", FORMATS)
def test_the_price_of_a_provider_holds_at_its_own_address(form, monkeypatch):
    elsewhere = {"base_url": "http://127.0.0.1:8000"}
    entry = entry_of(form, **elsewhere)
    assert batch_terms(entry) is None
    assert batch_terms(entry_of(form, **elsewhere, batch=OWN)) == OWN
    variable = PROVIDERS[entry.provider].base_url_env
    monkeypatch.setenv(variable, "http://127.0.0.1:8000")
    assert batch_terms(entry_of(form)) is None
    monkeypatch.delenv(variable)
    assert batch_terms(entry_of(form)).price_factor == 0.5
    assert batch_terms(entry_of(form, "emulator")).price_factor == 0.5
