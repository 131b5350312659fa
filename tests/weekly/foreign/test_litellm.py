"""A gateway that others wrote, before what fails: LiteLLM's proxy, where it is installed."""

import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections import Counter

import pytest

from tests.support.harness import environment, watched
from tests.support.mock_server import FaultPlan
from tests.weekly.foreign.conftest import urls_at

LITELLM = shutil.which("litellm")
BROKEN = ("rate_limit", "server_error", "overloaded", "reset", "truncated_body")
FAULTS = FaultPlan(seed=2, rates=dict.fromkeys(BROKEN, 0.04))
STARTING_S = 60

pytestmark = pytest.mark.skipif(
    LITELLM is None, reason="litellm is not installed: pip install 'litellm[proxy]'"
)


@pytest.fixture
async def upstream():
    """What the gateway asks: the emulator, with faults."""
    async with watched(faults=FAULTS) as server:
        yield server


@pytest.fixture
def url(tmp_path, upstream):
    """A gateway that tries nothing again by itself."""
    model = {"model": "openai/o3", "api_base": f"{upstream.url}/v1", "api_key": "x"}
    config = {
        "model_list": [{"model_name": "*", "litellm_params": model}],
        "litellm_settings": {"num_retries": 0, "telemetry": False},
    }
    (tmp_path / "litellm.yaml").write_text(json.dumps(config))  # JSON is YAML
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    env = environment(
        LITELLM_DANGEROUSLY_PERMIT_WEAK_OR_UNSET_MASTER_KEY="true",
        LITELLM_LOCAL_MODEL_COST_MAP="true",
    )
    config = ("--config", tmp_path / "litellm.yaml")
    with subprocess.Popen(
        [LITELLM, *config, "--port", str(port), "--host", "127.0.0.1"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=env,
    ) as process:
        until_alive(url)
        yield url
        process.terminate()


def until_alive(url):
    began = time.monotonic()
    while True:
        try:
            urllib.request.urlopen(f"{url}/health/liveliness").close()
        except OSError:
            assert time.monotonic() - began < STARTING_S
            time.sleep(0.2)
        else:
            return


async def test_a_sweep_in_each_format_passes_a_gateway_to_what_fails(url, upstream, sweeps):
    runs = await sweeps(urls_at(url))
    attempts = [run.summary["attempts"] for run in runs.values()]
    assert set().union(*attempts) > {"ok"}
    # It asks again by itself where a connection breaks.
    assert sum(each.total() for each in map(Counter, attempts)) <= upstream.requests
