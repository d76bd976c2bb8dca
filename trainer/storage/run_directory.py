"""Where the files of one run lie. Nothing else in the program puts such a path together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from onedemo.core.names import LONGEST, check_name

CLIP_FORMAT = 3
"""How clips are drawn: raised when another page must show them. Those of before are drawn again under another
name when somebody looks, and deleted as the oldest."""

_LONGEST = LONGEST + 20
"""Characters: a run without a name of its own is called after its demo, with a number behind."""


def check_run_name(name: str) -> None:
    """Raises UserError unless a run may be called so: it becomes the name of a directory."""
    check_name(name, longest=_LONGEST)


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """``runs/<run>/`` of a data directory; nothing of it need be there.

    The name of a run comes from a database, which may be somebody else's (restored, imported): it is
    checked here, where it becomes a path.

    Raises:
        UserError: If the name is not safe as the name of a directory.
    """

    data_dir: Path
    run: str

    def __post_init__(self) -> None:
        check_run_name(self.run)

    @property
    def path(self) -> Path:
        """The directory itself."""
        return self.data_dir / "runs" / self.run

    @property
    def config(self) -> Path:
        """Settings, as TOML."""
        return self.path / "config.toml"

    @property
    def lock(self) -> Path:
        """Held by the process that works on the run."""
        return self.path / "lock"

    @property
    def log(self) -> Path:
        """What the trainer said."""
        return self.path / "log"

    @property
    def start(self) -> Path:
        """The predictor of another run that this one starts from."""
        return self.path / "start.pt"

    @property
    def checkpoint(self) -> Path:
        """Where training was after the last iteration."""
        return self.path / "checkpoint.pt"

    @property
    def rollouts(self) -> Path:
        """Directory of the best rollouts."""
        return self.path / "rollouts"

    def snapshot(self, number: int) -> Path:
        """A fitted predictor."""
        return self.path / "snapshots" / f"{number:06d}.pt"

    def clip(self, number: int) -> Path:
        """The picture of a clip, all its frames; it is there once the clip is "ready"."""
        return self.path / "clips" / f"{number:06d}.{CLIP_FORMAT}.jpg"

    def pair(self, number: int) -> Path:
        """The picture of a pair; it is there once the pair is "ready"."""
        return self.path / "pairs" / f"{number:06d}.{CLIP_FORMAT}.jpg"
