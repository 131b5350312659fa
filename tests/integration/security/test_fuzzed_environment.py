"""Whatever variables say: an endpoint that can be asked, or one line that says what to type."""

from __future__ import annotations

import asyncio
import functools
import os

import httpx
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from merge_runner.config import ModelEntry, resolve_endpoint
from merge_runner.errors import UsageError
from merge_runner.llm.http import Connections, HttpTransport
from merge_runner.llm.http_outcome import TransportFailure
from tests.support.raw_server import a_request

ENTRY = ModelEntry(provider="openai", format="openai-chat", id="m", max_output_tokens=10)
SECRET = "sk-Zx81Qp55"
PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy", "all_proxy")
CHARACTERS = st.characters(exclude_categories=["Cs"], exclude_characters="\0")
HOSTS = st.one_of(
    st.sampled_from(
        [
            *("127.0.0.1", "localhost", "[::1]", "[::1", "::1", ""),
            *("a" * 64, "a" * 300, "a." * 150),
            *("999.1.1.1", "1.2.3", "..", ".a", "a..b", "xn--", "xn--\u00fc", "\u00fc", "*", "a b"),
            *("[fe80::1%25eth0]", "[v1.x]", "0x7f.1", "%41", "\\", "a\n", "\u2102", "a_b", "-"),
        ]
    ),
    st.text(CHARACTERS, max_size=12),
)
PORTS = st.one_of(
    st.just(""),
    st.integers(-2, 70_000).map(lambda port: f":{port}"),
    st.sampled_from([":", ":a", ":\u0661", ":0", ":1:2", ":" + "9" * 5000]),
)
SCHEMES = ("http://", "https://", "ftp://", "socks5://", "socks5h://", "//", "", "HTTP://")
PATHS = ("", "/", "/v1", "/v1/", "/ ", "/\u00fc", "?a", "#a", "/%", "/a b", "/" * 3000)
URLS = st.builds(
    "{}{}{}{}{}".format,
    st.sampled_from(SCHEMES),
    st.sampled_from(["", "", "", f"u:{SECRET}@", "@", "u@"]),
    HOSTS,
    PORTS,
    st.sampled_from(PATHS),
)
TEXTS = URLS | st.text(CHARACTERS)
ENVIRONMENTS = st.fixed_dictionaries(
    {},
    optional={
        "OPENAI_BASE_URL": URLS,
        "NO_PROXY": st.lists(TEXTS | HOSTS | st.just("*"), max_size=3).map(",".join),
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
    return failure.value.outcome


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
