"""Where a training was after an iteration: one file, replaced whole, and the one before it.

It holds what the learner is, the iteration's row in the database, and while there are questions left the
rollouts that they are cut from: a training that was killed asks what it would have asked.

Shapes: N lanes, T control steps.
"""

from __future__ import annotations

import io
import os
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from onedemo.core.files import read_whole, write_atomic
from onedemo.types import Rollouts

_UNSEEN = ("inputs", "next_inputs")
"""What no clip is cut from, the larger part: left out."""


def save_checkpoint(file: Path, learner: dict[str, Any], row: dict[str, Any], pool: Rollouts | None) -> None:
    """Writes a checkpoint.

    Args:
        file: Where.
        learner: ``Learner.state_dict``.
        row: What ``Store.runs.add_iteration`` is told.
        pool: Rollouts that clips are still cut from, (N, T); None if nobody is asked any more.

    Raises:
        OSError: If it cannot be written; the one before is then the newest.
    """
    buffer = io.BytesIO()
    torch.save({"learner": learner, "row": row, "pool": _pack(pool) if pool is not None else None}, buffer)
    with suppress(FileNotFoundError):
        os.replace(file, _before(file))
    write_atomic(file, buffer.getvalue())


def load_checkpoint(file: Path) -> tuple[dict[str, Any], dict[str, Any], Rollouts | None] | None:
    """What ``save_checkpoint`` was given last, or before that if the file is damaged; None if nothing is.

    The pool's policy inputs have width 0. Checkpoints of before pools were kept have none.
    """
    data = read_whole(file) or read_whole(_before(file))
    if data is None:
        return None
    saved = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    pool = saved.get("pool")
    return saved["learner"], saved["row"], _unpack(pool) if pool is not None else None


def _before(file: Path) -> Path:
    return file.with_name(f"{file.stem}-before{file.suffix}")


def _pack(pool: Rollouts) -> dict[str, torch.Tensor]:
    # Time first, as they lie in memory; copied, because a view would be saved with all that it is cut from.
    packed = {}
    for field in fields(Rollouts):
        value = getattr(pool, field.name)
        value = value[..., :0] if field.name in _UNSEEN else value
        packed[field.name] = torch.from_numpy(value.swapaxes(0, 1).copy())
    return packed


def _unpack(packed: dict[str, torch.Tensor]) -> Rollouts:
    if "env_rewards" in packed:  # as rewards were called in 0.1.0
        packed["rewards"] = packed.pop("env_rewards")
    return Rollouts(**{name: value.numpy().swapaxes(0, 1) for name, value in packed.items()})
