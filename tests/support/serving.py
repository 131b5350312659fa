"""An explorer in a thread of the tests' own process, and a program that holds its database."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import uvicorn

from merge_runner_analysis.explorer.app import explorer, listen
from merge_runner_analysis.explorer.site import Site


@contextmanager
def served(db: Path, port: int = 0):
    """The explorer of a database in a thread of its own; gives its address."""
    listener = listen(port)
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    server = uvicorn.Server(uvicorn.Config(explorer(Site(db)), log_level="warning", ws="none"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield f"http://{host}"
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def held(db: Path):
    """Another program holds the database, and has changed something."""
    holding = (
        "import duckdb, sys; c = duckdb.connect(sys.argv[1]); print('held', flush=True);"
        "sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", holding, str(db)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert holder.stdout.readline() == b"held\n"
    os.utime(db)
    try:
        yield
    finally:
        holder.communicate()
