"""``onedemo ...`` by forks of a process that has imported all of it, which takes 4 s of the processor.

What runs is the command's own ``main``, in a process of its own, which ends and is killed as any other.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(["onedemo.app.cli.run", "onedemo.app.cli.serve", "mjviser"])


def begin(words: Sequence[str], log: str = os.devnull) -> Child:
    """Begins ``onedemo`` with these words; what it says on stderr goes to the end of the log."""
    return Child(words, log)


class Child:
    """What is used of ``subprocess.Popen``."""

    def __init__(self, words: Sequence[str], log: str) -> None:
        ours, theirs = _context.Pipe(duplex=False)
        environment = dict(os.environ)
        self._process = _context.Process(
            target=_main, args=(list(words), theirs, log, environment, os.getcwd())
        )
        self._process.start()
        theirs.close()
        self.stdout = os.fdopen(os.dup(ours.fileno()))
        ours.close()
        self.pid = self._process.pid
        self.terminate, self.kill = self._process.terminate, self._process.kill

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired("onedemo", timeout or 0.0)
        return code


def _main(words: list[str], out: Connection, log: str, environment: dict[str, str], place: str) -> None:
    os.chdir(place)
    os.environ.clear()
    os.environ.update(environment)
    errors = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    os.dup2(out.fileno(), 1)
    os.dup2(errors, 2)
    os.close(errors)
    out.close()
    # What the parent had open as these was of another kind.
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
    from onedemo.app.cli.main import main

    sys.exit(main(words))
