"""Whatever variables say: an endpoint that can be asked, or one line that says what to type."""

import asyncio
import functools
import os

import httpx
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from merge_runner.errors import UsageError
from merge_runner.llm.http import Connections, HttpTransport
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.providers import ModelEntry, resolve_endpoint
from tests.support.raw_server import a_request

ENTRY = ModelEntry(provider="openai", format="openai-chat", id="m", max_output_tokens=10)
SECRET = "sk-Zx81Qp55"
PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy", "all_proxy")
CHARACTERS = st.characters(exclude_categories=["Cs"], exclude_characters="\0")
SCHEMES = ("http://", "https://", "ftp://", "socks5://", "//", "", "HTTP://")
PIECES = (
    *("127.0.0.1", "localhost", "[::1]", "[::1", "::1", "a" * 64, "a." * 150, "1.2.3", "..", "%41"),
    *("xn--", "\u00fc", "*", " ", "[fe80::1%25eth0]", "0x7f.1", "\\", "\n", "_", "-", "@", "u@"),
    *(f"u:{SECRET}@", ":", ":0", ":80", ":70000", ":\u0661", ":" + "9" * 5000),
    *("/", "/v1", "?", "#"),
)
URLS = st.builds(
    str.__add__,
    st.sampled_from(SCHEMES),
    st.lists(st.sampled_from(PIECES), max_size=5).map("".join),
)
TEXTS = URLS | st.text(CHARACTERS)
ENVIRONMENTS = st.fixed_dictionaries(
    {},
    optional={
        "OPENAI_BASE_URL": URLS,
        "NO_PROXY": st.lists(TEXTS | st.sampled_from(PIECES), max_size=3).map(",".join),
        "SSL_CERT_FILE": st.sampled_from(["", "/", "/nowhere", "/etc/hostname", "/dev/null", "\n"]),
        "SSL_CERT_DIR": st.sampled_from(["", "/", "/nowhere", "/nowhere:/", "/dev/null"]),
        **dict.fromkeys(PROXIES, TEXTS),
    },
)
KEYS = st.sampled_from(["sk-0123456789", "a", "\n", "k\r\nx: y", "\u00fc", "\t"]) | st.text()


@pytest.fixture(scope="module")
def alone():
    """The environment without anything that concerns a network."""
    # The same files again and again take no time.
    chosen = ("SSL_CERT_FILE", "SSL_CERT_DIR")
    made = httpx.create_ssl_context
    kept = functools.cache(lambda *_: made())

    def create(**options):
        return made(**options) if options else kept(*map(os.environ.get, chosen))

    async def nowhere(*_, **__):
        raise OSError("there is no network here")

    with pytest.MonkeyPatch.context() as patch:
        for name in [*os.environ]:
            if name.lower().endswith("_proxy") or name.startswith("SSL_CERT"):
                patch.delenv(name)
        patch.setattr(httpx, "create_ssl_context", create)
        patch.setattr(Connections, "_resolve_host", nowhere)  # of aiohttp
        yield


async def asked(variables):
    """What a request meets in this environment: the line that refuses it, or None."""
    endpoint = resolve_endpoint("m", ENTRY, {"OPENAI_API_KEY": SECRET, **variables})
    transport = HttpTransport(endpoint, connections=1)
    with pytest.raises(TransportFailure) as failure:
        await transport.send(a_request(), attempt=1, timeout_s=5)
    await transport.close()
    return failure.value.outcome.name


@given(ENVIRONMENTS)
@example({"OPENAI_BASE_URL": "http://" + "a" * 300})
@example({"SSL_CERT_FILE": "/nowhere"})
@example({"HTTP_PROXY": "ftp://proxy.invalid"})
@example({"ALL_PROXY": "socks5://127.0.0.1:9050"})
@example({"NO_PROXY": "http://[::1"})
def test_fuzz_of_variables_they_can_be_used_or_are_refused_in_one_line(alone, variables):
    os.environ.update(variables)
    try:
        assert asyncio.run(asked(variables)) == "no_connection"
    except UsageError as refused:
        said = str(refused)
    else:
        said = ""
    finally:
        for name in variables:
            del os.environ[name]
    assert said.isprintable()
    assert SECRET not in said
    assert len(said) < 400


@given(KEYS)
def test_fuzz_of_keys_each_is_sent_as_it_is_or_refused_and_not_shown(key):
    assume(key)
    try:
        endpoint = resolve_endpoint("m", ENTRY, {"OPENAI_API_KEY": key})
    except UsageError as refused:
        said, header = str(refused), "Bearer "
    else:
        said, header = "", endpoint.auth_headers["authorization"]
    assert header in ("Bearer ", f"Bearer {key}")
    assert header.isascii()
    assert header.isprintable()
    assert len(key) < 4 or key not in said
