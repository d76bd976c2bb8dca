"""What was learned of a robot's looks, kept by its model: in the data directory, or shipped with the program.

A file is of one model (by its hash), one way to learn it (by its version), and nothing else. Shipped files
hold half-precision numbers.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from onedemo import static
from onedemo.core.files import read_whole, write_atomic
from onedemo.core.names import check_name
from onedemo.robots.registry import robot_named

SHIPPED = Path(static.__file__).parent / "robots"


def model_name(env_name: str) -> str:
    """Names a robot, its model, and the plane in which it is seen, unless that is upright."""
    robot = robot_named(env_name)
    model = robot.model_sha256 or hashlib.sha256(robot.xml.read_bytes()).hexdigest()
    plane = (robot.camera.right, robot.camera.up)
    seen = "" if plane == (0, 2) else "-{}{}".format(*plane)
    return f"{check_name(env_name.replace(':', '-'))}-{model[:12]}{seen}"


def find(name: str, cache_dir: Path, *, shipped: bool = True) -> dict[str, np.ndarray] | None:
    """What was learned, in single precision; None if nothing was. What is in the data directory comes first.

    Args:
        name: Of the file, without its ending.
        cache_dir: Where it may be kept.
        shipped: Whether to look among the files that come with the program, too.
    """
    data = read_whole(cache_dir / f"{name}.npz")
    if data is None and shipped and (file := SHIPPED / f"{name}.npz").exists():
        data = file.read_bytes()
    if data is None:
        return None
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        return {key: _single(stored[key]) for key in stored.files}


def keep(name: str, directory: Path, tensors: Mapping[str, np.ndarray], *, half: bool = False) -> Path:
    """Keeps what was learned; the file.

    Args:
        name: Of the file, without its ending.
        directory: Where.
        tensors: What was learned.
        half: Whether in half precision, compressed.
    """
    buffer, path = io.BytesIO(), directory / f"{name}.npz"
    if half:
        np.savez_compressed(buffer, allow_pickle=False, **{k: np.float16(x) for k, x in tensors.items()})
    else:
        np.savez(buffer, allow_pickle=False, **tensors)
    write_atomic(path, buffer.getvalue())
    return path


def _single(x: np.ndarray) -> np.ndarray:
    return x.astype(np.float32) if x.dtype == np.float16 else x
