"""The library of demos: bring a video in, name it, list, find, read.

A demo is a directory ``<demos_dir>/<sha256>/`` with ``video.webm`` and ``demo.json``; the ones that
come with the program are ``static/demos/<name>.webm`` and ``<name>.json``. What is in them, and how it comes
about, is in ``preparing``.

Shapes: n frames, H rows, W columns, T control steps, q positions.
"""

from __future__ import annotations

import difflib
import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from onedemo import static
from onedemo.core.directories import Workshop, make_directory, sync_directory
from onedemo.core.files import hold, write_atomic
from onedemo.core.names import check_name, check_new_name
from onedemo.demos.containers import check_file
from onedemo.demos.edits import Options, check_options
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.preparing import ABOUT, VIDEO, demo_of, describe, origin_of, prepare_demo, sha256_of
from onedemo.demos.sandboxed_decoder import Limits
from onedemo.demos.video import VideoReader, jpeg, write_webm
from onedemo.errors import UserError
from onedemo.types import Demo

if TYPE_CHECKING:
    from onedemo.robots.robot import Robot

BUILT_IN = Path(static.__file__).parent / "demos"

_log = logging.getLogger(__name__)


def import_video(
    path: str | Path,
    *,
    name: str,
    demos_dir: Path,
    start: float | None = None,
    end: float | None = None,
    crop: tuple[int, int, int, int] | None = None,
    mirror: bool = False,
    fps: float = 30.0,
    speed: float = 1.0,
    reverse: bool = False,
    loop: int = 1,
    rotate: int = 0,
    track: bool = False,
    stabilise: bool = False,
    task: str = "",
    source: str = "",
    limits: Limits | None = None,
    warn: Callable[[str], object] = lambda _: None,
) -> Demo:
    """Brings a video in as a demo: trimmed, cropped, at a fixed rate, at most 640 px long.

    The same pictures are the same demo, whatever it is called the second time.

    Args:
        path: Any video file that FFmpeg decodes.
        name: What to call it: letters, digits, '-' and '_', at most 64.
        demos_dir: Where demos are kept.
        start: First moment to use, seconds.
        end: Last moment to use, seconds; past the end of the video means all of it.
        crop: (x, y, width, height) of the part to use, pixels of the upright source.
        mirror: Swap left and right.
        fps: Frame rate to bring it to, 1..120.
        speed: How many times faster it is played, 0.1..20.
        reverse: Play it backwards.
        loop: How many times it is shown, end to end; 0: as often as fits into 8 s.
        rotate: Degrees clockwise: 0, 90, 180 or 270.
        track: Let a crop of fixed size follow what moves: ``crop`` what moves in it at first.
        stabilise: Hold the background still.
        task: The hand-coded reward that describes the move, if known.
        source: Where the video is from; its file name if empty.
        limits: What decoding it may take; the defaults if None.
        warn: Called with each sentence about what is not as it should be, though usable.

    Returns:
        The demo, stored.

    Raises:
        UserError: If the video or an option is unusable; nothing is then stored.
    """
    path, demos_dir = Path(path), Path(demos_dir)
    check_new_name(check_name(name))
    options = Options(
        start=start, end=end, crop=crop, mirror=mirror, fps=fps, speed=speed, reverse=reverse, loop=loop,
        rotate=rotate, track=track, stabilise=stabilise,
    )  # fmt: skip
    check_options(options)
    check_file(path)
    stored = list(_load_all(demos_dir))
    origin = origin_of(path, options)
    for demo, about in stored:
        if {key: about.get(key) for key in origin} == origin:
            return demo
    _check_free(name, (demo for demo, _ in stored))
    try:
        make_directory(demos_dir, private=True)
        place = Workshop(demos_dir, ".import-")
    except OSError as error:
        raise UserError(f"cannot store demos in {demos_dir}: {error.strerror}") from error
    with place as workshop:
        source = source or os.fsencode(path.name).decode("utf-8", "replace")
        prepare_demo(path, options, workshop, task=task, source=source, limits=limits, warn=warn)
        return keep_demo(workshop, name, demos_dir)


def keep_demo(place: Path, name: str, demos_dir: Path) -> Demo:
    """Makes what was prepared a demo; gives the one there is if it has the same pictures.

    Args:
        place: What ``prepare_demo`` has filled; it is gone afterwards unless the demo was known.
        name: What to call it.
        demos_dir: Where demos are kept; made if missing.

    Raises:
        UserError: If the name is not allowed or taken.
    """
    check_new_name(check_name(name))
    make_directory(demos_dir, private=True)
    about = json.loads((place / ABOUT).read_bytes()) | {"name": name}
    with _names(demos_dir):  # somebody else may have added one meanwhile
        if known := known_demo(about["sha256"], demos_dir):
            return known
        _check_free(name, list_demos(demos_dir))
        write_atomic(place / ABOUT, json.dumps(about, indent=1).encode() + b"\n")
        final = demos_dir / about["sha256"]
        shutil.rmtree(final, ignore_errors=True)  # what a deleted demo left behind
        os.replace(place, final)
        sync_directory(demos_dir)
    return demo_of(about, final / VIDEO)


def known_demo(sha256: str, demos_dir: Path) -> Demo | None:
    """The demo of these pictures, whatever it is called; None if there is none."""
    return next((demo for demo in list_demos(demos_dir) if demo.sha256 == sha256), None)


def demo_picture(demo: Demo, width: int = 320) -> bytes:
    """A frame from the middle of a demo as JPEG, that wide.

    Raises:
        UserError: If the stored file is missing or damaged.
    """
    middle = next(islice(stream_frames(demo), demo.frames // 2, None))
    return jpeg(middle, width)


def remove_demo(demo: Demo, demos_dir: Path) -> None:
    """Deletes a demo with all that was made from its pictures.

    Raises:
        UserError: If it came with the program, or cannot be deleted.
    """
    directory = _own_directory(demo, demos_dir)
    try:
        with Workshop(demos_dir, ".import-") as away:
            os.replace(directory, away / "gone")  # at once: half a demo would be a damaged one
            sync_directory(demos_dir)
    except OSError as error:
        raise UserError(f"cannot delete {directory}: {error.strerror}") from error


def rename_demo(demo: Demo, name: str, demos_dir: Path) -> Demo:
    """Gives a demo another name.

    Raises:
        UserError: If it came with the program, or the name is not allowed or taken.
    """
    check_new_name(check_name(name))
    path = _own_directory(demo, demos_dir) / ABOUT
    with _names(demos_dir):
        _check_free(name, list_demos(demos_dir))
        about = json.loads(path.read_bytes()) | {"name": name}
        write_atomic(path, json.dumps(about, indent=1).encode() + b"\n")
    return replace(demo, name=name)


def render_demo(
    qpos_Tq: np.ndarray,
    *,
    name: str,
    task: str,
    source: str,
    out_dir: Path = BUILT_IN,
    robot: Robot | None = None,
    fps: float = 30.0,
) -> Demo:
    """Films stored positions: ``<out_dir>/<name>.webm`` and ``<name>.json``, 480 x 360.

    Args:
        qpos_Tq: Positions at each control step, (T + 1, q) or (T, q), metres and radians.
        name: The demo's name.
        task: The hand-coded reward that describes the move.
        source: The command or study that made the motion.
        out_dir: Where to write; overwrites files of the same name.
        robot: Whose positions; the hopper's if None.
        fps: Frames per second.

    Returns:
        The demo.

    Raises:
        UserError: If the name is not allowed or this machine cannot draw.
    """
    from onedemo.render.renderer import Renderer
    from onedemo.robots.registry import DEFAULT, robot_named

    check_name(name)
    robot = robot or robot_named(DEFAULT)
    dt = robot.dt
    count = math.floor(len(qpos_Tq) * dt * fps + 1e-9)
    steps = np.minimum(steps_of_frames(count, dt, fps), len(qpos_Tq) - 1)
    with Renderer(robot=robot) as renderer:
        frames = renderer.render(np.asarray(qpos_Tq)[steps])
    out_dir.mkdir(parents=True, exist_ok=True)
    temporary = out_dir / f".{name}.partial.webm"
    try:
        write_webm(temporary, frames, fps=fps)
        about = describe(
            out_dir / f"{name}.json",
            temporary,
            name=name,
            sha256=sha256_of(temporary),
            fps=fps,
            frames=count,
            task=task,
            source=source,
            robot=robot.name,
        )
        os.replace(temporary, out_dir / f"{name}.webm")
    finally:
        temporary.unlink(missing_ok=True)
    return demo_of(about, out_dir / f"{name}.webm")


def list_demos(demos_dir: Path) -> list[Demo]:
    """All demos, the built-in ones included, by name. Damaged ones are logged and left out."""
    return sorted((demo for demo, _ in _load_all(Path(demos_dir))), key=lambda demo: demo.name)


def built_in() -> list[Demo]:
    """The demos that come with the program, by name."""
    return [demo for demo in list_demos(BUILT_IN / "none") if demo.path.parent == BUILT_IN]


def is_whole(demo: Demo) -> bool:
    """Whether the stored video is, to the byte, what was stored."""
    about = demo.path.with_name(ABOUT) if demo.path.name == VIDEO else demo.path.with_suffix(".json")
    try:
        known = json.loads(about.read_bytes())
        return sha256_of(demo.path) == known.get("video_sha256", known["sha256"])
    except (OSError, ValueError, KeyError):
        return False


def find_demo(name: str, demos_dir: Path) -> Demo:
    """The demo of that name.

    Raises:
        UserError: If there is none, with the names that exist and the nearest of them.
    """
    demos = {demo.name: demo for demo in list_demos(demos_dir)}
    if name in demos:
        return demos[name]
    near = difflib.get_close_matches(name, demos, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise UserError(f"there is no demo called {name!r}{hint}; known demos: {', '.join(demos) or 'none'}")


def read_frames(demo: Demo) -> np.ndarray:
    """Decodes the demo's frames, all at once.

    Returns:
        Frames, (n, H, W, 3), uint8 RGB.

    Raises:
        UserError: If the stored file is missing or damaged.
    """
    frames = np.empty((0, 0, 0, 3), np.uint8)
    for i, frame in enumerate(stream_frames(demo)):
        if i == 0:
            frames = np.empty((demo.frames, *frame.shape), np.uint8)
        frames[i] = frame
    return frames


def stream_frames(demo: Demo) -> Iterator[np.ndarray]:
    """Decodes the demo's frames one by one: a long demo takes no more memory than a short one.

    Yields:
        As many frames as the demo has, (H, W, 3), uint8 RGB.

    Raises:
        UserError: If the stored file is missing or damaged; frames may have come before.
    """
    count = 0
    try:
        with VideoReader(demo.path) as reader:
            for frame in reader.frames():
                count += 1
                if count > demo.frames:
                    break
                yield frame
    except UserError:  # its advice is for videos on their way in
        pass
    if count != demo.frames:
        raise UserError(
            f"the stored video {demo.path} is missing or damaged: {count} of {demo.frames} frames "
            "can be read; delete its directory and add the demo again"
        )


def show(demo: Demo) -> str:
    """What a person wants to know about a demo, a few lines of text."""
    lines = {
        "name": demo.name,
        "length": f"{demo.seconds:.2f} s, {demo.frames} frames at {demo.fps:g} per second",
        "size": f"{demo.width} x {demo.height} pixels",
        "task": demo.task or "not named",
        "source": demo.source or "not named",
        "edits": demo.edits or "none",
        "file": str(demo.path),
        "sha256": demo.sha256,
    }
    return "\n".join(f"{key:<7} {value}" for key, value in lines.items())


def _names(demos_dir: Path) -> AbstractContextManager[None]:
    """One process at a time gives a name."""
    return hold(demos_dir.with_name(f"{demos_dir.name}.lock"), wait=True)


def _check_free(name: str, demos: Iterable[Demo]) -> None:
    if name in {demo.name for demo in demos}:
        raise UserError(f"the name {name} is taken by another demo; choose another --name")


def _own_directory(demo: Demo, demos_dir: Path) -> Path:
    """Where a demo of this library lies."""
    directory = demo.path.parent
    if directory.parent != demos_dir:
        raise UserError(f"the demo {demo.name} comes with the program: it can be neither removed nor renamed")
    return directory


def _load_all(demos_dir: Path) -> Iterator[tuple[Demo, dict[str, Any]]]:
    places = [(path, path.with_suffix(".webm")) for path in sorted(BUILT_IN.glob("*.json"))]
    for path in sorted(demos_dir.glob(f"*/{ABOUT}")):
        if not path.parent.name.startswith("."):
            places.append((path, path.parent / VIDEO))
    for path, video in places:
        try:
            about = json.loads(path.read_bytes())
            if not video.is_file():
                raise FileNotFoundError(video)
            yield demo_of(about, video), about
        except (OSError, ValueError, KeyError, TypeError) as error:
            _log.warning("demo left out, %s is damaged: %r", path, error)
