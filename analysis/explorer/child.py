"""A child process that answers requests: how it is asked, bounded and killed, and how it answers.

A request is a line of JSON on its standard input. An answer is a line of JSON on its standard
output, with ``error`` where there is one, and ``bytes`` says how many bytes follow it.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from merge_runner.errors import MergeRunnerError

Answer = tuple[dict[str, Any], bytes]


class NoAnswer(Exception):
    """Why there is no answer, in a line."""


class Ended(Exception):
    """A child ended without an answer; ``late``: it was killed because its time was over."""

    def __init__(self, code: int, *, late: bool) -> None:
        super().__init__(f"exit code {code}")
        self.code = code
        self.late = late


class Child:
    """A process that runs one of our modules, and ends with this one."""

    def __init__(
        self,
        module: str,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        files: Sequence[int] = (),
        quiet: bool = False,
    ) -> None:
        """Start it, in our own ``environment`` if none is given; raises NoAnswer.

        It gets these open ``files``; a ``quiet`` one prints no errors.
        """
        # -P: no file of the working folder is taken for one of our modules.
        command = [sys.executable, "-P", "-X", "utf8", "-m", module, *arguments]
        try:
            self.process = subprocess.Popen(  # noqa: S603 # our own program
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL if quiet else None,
                env=environment,
                pass_fds=files,
                start_new_session=True,  # Ctrl-C is for the server, which then ends its children
            )
        except OSError as exc:
            raise NoAnswer(f"no process can be started: {exc.strerror}") from exc

    def give_study(self) -> None:
        """Send the study that is in use here, whatever stands in its files by now."""
        from merge_runner.registry import in_use  # the process of queries has no use for it

        sent = (in_use().text, in_use().plugins)
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # whoever asks it is told that it ended
            self.process.stdin.write(json.dumps(sent).encode() + b"\n")

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return self.process.poll() is None

    def ask(self, request: object, *, seconds: float, most_bytes: int) -> Answer:
        """The answer; raises NoAnswer where it is an error or too large, and Ended."""
        late = threading.Event()

        def stop() -> None:
            late.set()
            self.process.kill()

        # A read from a pipe has no time limit of its own.
        clock = threading.Timer(seconds, stop)
        clock.start()
        try:
            said, body = self._exchange(request, most_bytes)
        except (EOFError, OSError, ValueError) as exc:  # it is dead, or another thread closed it
            # Its pipe closes before it is gone: killed now, it would not tell its exit code.
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(1)
            self.close()
            raise Ended(self.process.returncode, late=late.is_set()) from exc
        finally:
            clock.cancel()
        if "error" in said:
            raise NoAnswer(said["error"])
        return said, body

    def _exchange(self, request: object, most_bytes: int) -> Answer:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(request).encode() + b"\n")
        self.process.stdin.flush()
        head = self.process.stdout.readline(most_bytes)
        whole = head.endswith(b"\n")
        said: dict[str, Any] = json.loads(head) if whole else {"bytes": 0}
        following = said.pop("bytes")
        if len(head) + following > most_bytes or (len(head) == most_bytes and not whole):
            self.close()  # whatever else it says would be taken for the next answer
            raise NoAnswer("the result is too large to be shown: select less of it")
        body = self.process.stdout.read(following)
        if not whole or len(body) < following:
            raise EOFError
        return said, body

    def close(self) -> None:
        """End it, whatever is under way."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):  # of a request that it did not read
                    pipe.close()


def use_given() -> None:
    """In the child: use the study that ``give_study`` sends."""
    from merge_runner.registry import use
    from merge_runner.study.file import StudyFile
    from merge_runner.study.parts import catalogue_of

    text, plugins = json.loads(sys.stdin.readline())
    if text:
        use(catalogue_of(StudyFile.model_validate(tomllib.loads(text)), text, plugins))


def serve(answer: Callable[[Any], Answer]) -> None:
    """In the child: answer until standard input ends, also amid a request.

    Whoever asked is gone then, even if it was killed.
    """
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    asked: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            asked.put(line)
        os._exit(0)

    # The main thread is busy with a request: only another one sees that the input has ended.
    threading.Thread(target=listen, daemon=True).start()
    while True:
        try:
            said, body = answer(json.loads(asked.get()))
        except MergeRunnerError as exc:
            said, body = {"error": str(exc)}, b""
        head = json.dumps({**said, "bytes": len(body)}, ensure_ascii=False)
        answers.write(head.encode(errors="surrogatepass") + b"\n" + body)
        answers.flush()
