"""Finds the mover in a process of its own, so that neither the page nor training waits for it.

It is bounded in time and memory, and gives way to whatever else computes. What goes in is JSON in its
arguments; what comes out is the file of the masks, or a sentence on its standard error.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from onedemo.core.process import prepare_process
from onedemo.errors import UserError
from onedemo.types import Demo
from onedemo.vision.mask_hints import Box, Click, Hints

LONGEST_S = 240.0
"""Seconds that it may take: a minute of video takes one, on a machine that is not busy."""
_MEMORY = 4 << 30
"""Bytes of address space where the system limits it; a minute of video takes 1 GB of memory."""
_REFUSED = 3


def find_in_child(demo: Demo, hints: Hints, out: Path, seconds: float = LONGEST_S) -> None:
    """Finds the mover of a demo and writes ``out``, as ``write_masks``.

    Args:
        demo: May be one that is not kept yet.
        hints: In pixels of the demo.
        out: Where.
        seconds: That it may take.

    Raises:
        UserError: If it takes longer, or its video is damaged, or nothing was found where somebody marked it.
    """
    from onedemo.vision.mask_file import plain

    told = json.dumps({"demo": _plain(demo), "hints": plain(hints), "out": str(out)})
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "onedemo.vision.mask_child", told],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            timeout=seconds, env=os.environ | {"OMP_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise UserError(
            f"what moves was not found within {seconds:g} s; choose a shorter part of the video"
        ) from None
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    if done.returncode == _REFUSED and said:
        raise UserError(said[-1])
    if done.returncode:
        why = said[-1][:300] if said else f"status {done.returncode}"
        raise UserError(f"what moves was not found: the process that looks for it ended with: {why}")


def hints_of(told: dict[str, Any]) -> Hints:
    """The reverse of ``mask_file.plain``.

    Raises:
        ValueError: If it is something else.
    """
    given, clicks = told.get("box") or None, told.get("clicks") or []
    if given is not None and not _numbers(given, 5):
        raise ValueError("a box is five numbers: x, y, width, height, frame")
    if not isinstance(clicks, list) or not all(_numbers(click, 4) for click in clicks):
        raise ValueError("a mark is four numbers: x, y, frame, and 1 if it is on what moves, else 0")
    box = None
    if given is not None:
        x, y, width, height, frame = given
        box = Box(frame=int(frame), x=x, y=y, width=width, height=height)
    found = [Click(frame=int(frame), x=x, y=y, inside=bool(inside)) for x, y, frame, inside in clicks]
    return Hints(box=box, clicks=tuple(found))


def _numbers(values: Any, count: int) -> bool:
    return (
        isinstance(values, list)
        and len(values) == count
        and all(type(value) in (int, float) and abs(value) < 1e6 for value in values)  # no nan either
    )


def _plain(demo: Demo) -> dict[str, Any]:
    return {name: getattr(demo, name) for name in ("fps", "frames", "width", "height")} | {
        "path": str(demo.path)
    }


def _main(told: str) -> int:
    prepare_process()
    with suppress(OSError):
        os.nice(10)
    with suppress(ImportError, ValueError, OSError):  # not every system has such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import cv2

    from onedemo.vision.mask_file import check_found, find_mover, write_masks

    cv2.setNumThreads(1)
    wanted = json.loads(told)
    about = wanted["demo"]
    demo = Demo(
        name="", sha256="", path=Path(about["path"]), fps=about["fps"], frames=about["frames"],
        width=about["width"], height=about["height"],
    )  # fmt: skip
    hints = hints_of(wanted["hints"])
    try:
        masks = find_mover(demo, hints)
        if hints:
            check_found(masks)
        write_masks(Path(wanted["out"]), masks, hints)
    except (UserError, OSError) as error:
        print(error, file=sys.stderr)
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1]))
