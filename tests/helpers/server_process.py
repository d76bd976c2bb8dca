"""``onedemo serve`` as a child process, as a person starts it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from helpers import warm


class Serving:
    """Starts servers on one data directory and ends them all at last."""

    begin = staticmethod(warm.begin)

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir
        self._stack = ExitStack()

    def start(self, *options: str) -> tuple[warm.Child, dict[str, str], Path]:
        """The process, its links once it is ready (none if it ends before), and what it says on stderr."""
        log = self.data_dir.with_name(f"{self.data_dir.name}.log")
        log.write_text("")
        child = self.begin(["serve", "--data-dir", str(self.data_dir), *options], str(log))
        self._stack.callback(self._end, child)
        lines = [child.stdout.readline() for _ in range(2)]
        return child, dict(line.strip().split(": ", 1) for line in lines if line), log

    def close(self) -> None:
        """Ends every server that still runs."""
        self._stack.close()

    @staticmethod
    def _end(child: warm.Child) -> None:
        child.kill()
        child.wait()
        child.stdout.close()
