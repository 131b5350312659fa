"""Asks a zygote (``tests.zygote``) to run the program; as a script, ``merge-runner`` for a shell.

The script imports next to nothing: it is run by ``python -I -S``.
"""

import json
import os
import signal
import socket
import sys

DIGITS = 10  # of a process id, as it is told


def asked(address, arguments, *, cwd, env, streams, module="") -> socket.socket:
    """The link on which the zygote will tell the process's id and, once it has ended, its code."""
    request = {"arguments": arguments, "cwd": cwd, "env": env, "module": module}
    link = socket.socket(socket.AF_UNIX)
    link.connect(address)
    socket.send_fds(link, [json.dumps(request).encode()], streams)
    link.shutdown(socket.SHUT_WR)
    return link


def main() -> int:
    """Run the program with our arguments, folder, variables and streams, and hand signals on."""
    here = os.getcwd()
    env = dict(os.environ)
    told = (signal.SIGINT, signal.SIGTERM)
    # A signal that comes before the child is known waits for it.
    signal.pthread_sigmask(signal.SIG_BLOCK, told)
    with asked(env["ZYGOTE"], sys.argv[1:], cwd=here, env=env, streams=[0, 1, 2]) as link:
        child = int(link.recv(DIGITS, socket.MSG_WAITALL))
        for number in told:
            signal.signal(number, lambda sent, _: os.kill(child, sent))
        signal.pthread_sigmask(signal.SIG_UNBLOCK, told)
        code = int(link.recv(DIGITS))
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main())
