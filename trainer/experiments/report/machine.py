"""What figures were taken on: machine, versions, commit."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from onedemo.core.cpu import cores

_PACKAGES = (
    "mujoco", "gymnasium", "torch", "numpy", "viser", "opencv-python-headless", "envpool", "sb3-contrib",
    "mujoco-warp",
)  # fmt: skip
_ROOT = Path(__file__).parents[3]


def machine() -> dict[str, Any]:
    """Cores, processor, Python and the packages that matter, ready for JSON."""
    packages = {}
    for name in _PACKAGES:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "cores": cores(),
        "processor": _processor(),
        "python": platform.python_version(),
        "packages": packages,
    }


def program() -> dict[str, Any]:
    """``version`` of onedemo, and ``commit`` of its source tree: None if it is not in one.

    The commit ends in "-dirty" if something was changed since.
    """
    return {"version": version("onedemo"), "commit": _commit()}


def now() -> str:
    """Date and time, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(": ", 1)[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def _commit() -> str | None:
    if not (_ROOT / ".git").exists():  # an installed package, perhaps inside somebody else's repository
        return None
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=10"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
