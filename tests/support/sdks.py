"""The clients of the providers' own libraries, at a URL."""

import os

import pytest


def openai_client(url):
    from openai import AsyncOpenAI

    return AsyncOpenAI(api_key="dummy", base_url=f"{url}/v1", max_retries=0, timeout=10)


def anthropic_client(url):
    from anthropic import AsyncAnthropic

    return AsyncAnthropic(api_key="dummy", base_url=url, max_retries=0, timeout=10)


def gemini_client(url, api_version="v1beta"):
    from google import genai

    # Its timeout is in ms; it does not retry unless told to.
    options = genai.types.HttpOptions(base_url=url, timeout=10_000, api_version=api_version)
    return genai.Client(api_key="dummy", http_options=options)


@pytest.fixture
def no_settings_of_the_user(monkeypatch):
    # Proxies would lead away from loopback, and the libraries read much more than keys.
    for name in list(os.environ):
        if name.upper().endswith("_PROXY") or name.startswith(("OPENAI_", "ANTHROPIC_", "GOOGLE_")):
            monkeypatch.delenv(name)
