"""Servers on loopback, and nothing of the user's settings."""

from contextlib import closing

import pytest

from merge_runner.llm.cache import ResponseCache
from tests.support.emulator_fixtures import emulator


@pytest.fixture(autouse=True)
def _no_settings_of_the_user(monkeypatch, tmp_path):
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)
    # Nothing here speaks TLS, and to load the certificates takes longer than most of the tests.
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One folder for all tests of a file: to make a durable one takes a while."""
    with closing(ResponseCache(tmp_path_factory.mktemp("responses"))) as opened:
        yield opened
