"""The library of demos: bring a video in, normalise it, list, find, read.

A demo is a directory ``<demos_dir>/<sha256>/`` with ``video.webm`` and ``demo.json``; the ones that
come with the program are ``static/demos/<name>.webm`` and ``<name>.json``. What a demo is, is its pictures:
``sha256`` is of the frames as they were handed to the encoder, so that the same video gives the same demo
anywhere, and ``video_sha256`` is of the file. In demos of before 2026-11-29, and in the built-in ones,
``sha256`` is of the file.

Shapes: n frames, H rows, W columns, T control steps, q positions.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from onedemo import static
from onedemo.core.directories import Workshop, make_directory, sync_directory
from onedemo.core.files import hold, write_atomic
from onedemo.core.names import check_name, check_new_name
from onedemo.demos.containers import check_file
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.import_checks import StoredCheck, check_options
from onedemo.demos.sandboxed_decoder import DECODING, Limits, Options, decode
from onedemo.demos.video import VideoReader, jpeg, write_webm
from onedemo.errors import UserError
from onedemo.types import Demo

if TYPE_CHECKING:
    from onedemo.robots.robot import Robot

BUILT_IN = Path(static.__file__).parent / "demos"
_VIDEO, _ABOUT = "video.webm", "demo.json"
"""The two files of a demo of the library."""

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
    check_options(start=start, end=end, crop=crop, fps=fps)
    check_file(path)
    options = Options(start=start, end=end, crop=crop, mirror=mirror, fps=fps)
    stored = list(_load_all(demos_dir))
    origin = _origin(path, options)
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


def prepare_demo(
    path: Path,
    options: Options,
    place: Path,
    *,
    task: str = "",
    source: str,
    limits: Limits | None = None,
    warn: Callable[[str], object] = lambda _: None,
) -> Demo:
    """Brings a video in as a demo that is not kept yet, nor named: its files are in ``place`` afterwards.

    Args:
        path: The video; ``check_file`` and ``check_options`` have found nothing wrong.
        options: Which part of it, and how.
        place: An empty directory on the file system of the library.
        task: The hand-coded reward that describes the move, if known.
        source: Where the video is from.
        limits: What decoding it may take; the defaults if None.
        warn: Called with each sentence about what is not as it should be, though usable.

    Returns:
        The demo, without a name.

    Raises:
        UserError: If the video is unusable.
    """
    video = place / _VIDEO
    check, pictures = StoredCheck(), hashlib.sha256(f"{options.fps:g}".encode())
    with closing(decode(path, options, limits, warn)) as frames:
        count = write_webm(video, _noting(frames, check, pictures), fps=options.fps)
    check.check_pictures(str(path))
    with VideoReader(video) as reader:
        for frame in reader.frames():
            check.stored(frame)
    about = _describe(
        place / _ABOUT,
        video,
        name="",
        sha256=pictures.hexdigest(),
        video_sha256=_sha256(video),
        fps=options.fps,
        frames=count,
        task=task,
        source=source,
        **_origin(path, options),
    )
    return _demo(about, video)


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
    about = json.loads((place / _ABOUT).read_bytes()) | {"name": name}
    with _names(demos_dir):  # somebody else may have added one meanwhile
        if known := known_demo(about["sha256"], demos_dir):
            return known
        _check_free(name, list_demos(demos_dir))
        write_atomic(place / _ABOUT, json.dumps(about, indent=1).encode() + b"\n")
        final = demos_dir / about["sha256"]
        shutil.rmtree(final, ignore_errors=True)  # what a deleted demo left behind
        os.replace(place, final)
        sync_directory(demos_dir)
    return _demo(about, final / _VIDEO)


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


def _origin(path: Path, options: Options) -> dict[str, Any]:
    """What a demo was made of, and how: of the same, the frames are the same and need not be decoded."""
    wanted = asdict(options) | {"crop": list(options.crop) if options.crop else None}
    return {"source_sha256": _sha256(path), "options": wanted, "decoding": DECODING}


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
    path = _own_directory(demo, demos_dir) / _ABOUT
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
        about = _describe(
            out_dir / f"{name}.json",
            temporary,
            name=name,
            sha256=_sha256(temporary),
            fps=fps,
            frames=count,
            task=task,
            source=source,
            robot=robot.name,
        )
        os.replace(temporary, out_dir / f"{name}.webm")
    finally:
        temporary.unlink(missing_ok=True)
    return _demo(about, out_dir / f"{name}.webm")


def list_demos(demos_dir: Path) -> list[Demo]:
    """All demos, the built-in ones included, by name. Damaged ones are logged and left out."""
    return sorted((demo for demo, _ in _load_all(Path(demos_dir))), key=lambda demo: demo.name)


def built_in() -> list[Demo]:
    """The demos that come with the program, by name."""
    return [demo for demo in list_demos(BUILT_IN / "none") if demo.path.parent == BUILT_IN]


def is_whole(demo: Demo) -> bool:
    """Whether the stored video is, to the byte, what was stored."""
    about = demo.path.with_name(_ABOUT) if demo.path.name == _VIDEO else demo.path.with_suffix(".json")
    try:
        known = json.loads(about.read_bytes())
        return _sha256(demo.path) == known.get("video_sha256", known["sha256"])
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
        "file": str(demo.path),
        "sha256": demo.sha256,
    }
    return "\n".join(f"{key:<7} {value}" for key, value in lines.items())


def _noting(
    frames: Iterable[np.ndarray], check: StoredCheck, pictures: hashlib._Hash
) -> Iterator[np.ndarray]:
    """The same frames; what they show is noted on the way."""
    for number, frame in enumerate(frames):
        if number == 0:
            pictures.update(str(frame.shape).encode())
        pictures.update(frame.data)
        yield check.given(frame)


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


def _describe(path: Path, video: Path, **about: Any) -> dict[str, Any]:
    """Writes the demo's JSON and returns it."""
    with VideoReader(video) as reader:
        about |= {"width": reader.width, "height": reader.height}
    write_atomic(path, json.dumps(about, indent=1).encode() + b"\n")
    video.chmod(path.stat().st_mode & 0o777)  # OpenCV lets everybody read it
    return about


def _load_all(demos_dir: Path) -> Iterator[tuple[Demo, dict[str, Any]]]:
    places = [(path, path.with_suffix(".webm")) for path in sorted(BUILT_IN.glob("*.json"))]
    for path in sorted(demos_dir.glob(f"*/{_ABOUT}")):
        if not path.parent.name.startswith("."):
            places.append((path, path.parent / _VIDEO))
    for path, video in places:
        try:
            about = json.loads(path.read_bytes())
            if not video.is_file():
                raise FileNotFoundError(video)
            yield _demo(about, video), about
        except (OSError, ValueError, KeyError, TypeError) as error:
            _log.warning("demo left out, %s is damaged: %r", path, error)


def _demo(about: dict[str, Any], video: Path) -> Demo:
    return Demo(
        name=str(about["name"]),
        sha256=str(about["sha256"]),
        path=video,
        fps=float(about["fps"]),
        frames=int(about["frames"]),
        width=int(about["width"]),
        height=int(about["height"]),
        task=str(about.get("task", "")),
        source=str(about.get("source", "")),
        robot=str(about.get("robot", "")),
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
