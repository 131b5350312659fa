"""A unit test stays within its process: it starts no other, and asks and serves nobody."""

import socket
import subprocess

import pytest


@pytest.fixture(autouse=True)
def _stays_within_its_process(monkeypatch):
    def refuse(*_, **__):
        pytest.fail("a unit test starts no process and opens no connection: tests/integration")

    monkeypatch.setattr(subprocess.Popen, "__init__", refuse)
    monkeypatch.setattr(socket.socket, "bind", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
