"""``onedemo serve`` as a child process, as a person starts it."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path


class Serving:
    """Starts servers on one data directory and ends them all at last."""

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir
        self._stack = ExitStack()

    def start(self, *options: str) -> tuple[subprocess.Popen, dict[str, str], Path]:
        """The process, its links once it is ready (none if it ends before), and what it says on stderr."""
        log = self.data_dir.with_name(f"{self.data_dir.name}.log")
        errors = self._stack.enter_context(log.open("w"))
        command = [
            sys.executable,
            "-m",
            "onedemo.app.cli",
            "serve",
            "--data-dir",
            str(self.data_dir),
            *options,
        ]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        self._stack.callback(self._end, child)
        assert child.stdout is not None
        lines = [child.stdout.readline() for _ in range(2)]
        return child, dict(line.strip().split(": ", 1) for line in lines if line), log

    def close(self) -> None:
        """Ends every server that still runs."""
        self._stack.close()

    @staticmethod
    def _end(child: subprocess.Popen) -> None:
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()
