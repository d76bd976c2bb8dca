"""The commands for demonstration videos: ``demo add``, ``list``, ``show``, ``rename``, ``remove``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from onedemo.app.cli.data import DATA, DataDir
from onedemo.core.outputs import check_data_dir
from onedemo.errors import UserError

if TYPE_CHECKING:
    from onedemo.storage.store import Store

demo = App(name="demo", help="Bring in and look at demonstration videos.")


@demo.command
def add(
    video: Path, /, *others: Path, name: str, start: float | None = None, end: float | None = None,
    rotate: str = "0", stabilise: bool = False, crop: str | None = None, track: bool = False,
    mirror: bool = False, speed: str = "1", reverse: bool = False, loop: str | bool = False,
    fps: float = 30.0, box: str | None = None, data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """Bring in a video.

    Args:
        video: Any video file that FFmpeg decodes: mp4, mov, webm, mkv, avi, gif and many more.
        others: None: a demo is made of one video.
        name: What to call it.
        start: Begin at this second.
        end: End at this second.
        rotate: Turn it clockwise: 90, 180 or 270 degrees.
        stabilise: Hold the background still.
        crop: Keep this rectangle: X,Y,W,H in pixels, once it is turned.
        track: Let the rectangle follow what moves in it at first; without --crop, all that moves.
        mirror: Swap left and right.
        speed: Play it so many times faster, 0.1 to 20: the video shows the move slowed.
        reverse: Play it backwards.
        loop: Repeat it so many times, end to end; without a number as often as fits into 8 s.
        fps: Frames per second to keep.
        box: What moves is inside this rectangle, if it is not found by itself: X,Y,W,H[@SECONDS], in pixels
            and seconds of the demo as it is kept.
    """
    from onedemo.demos.edits import read_crop, read_loop, read_rotation, read_speed
    from onedemo.demos.library import import_video
    from onedemo.vision.mask_file import find_and_keep, hints_of_box, in_words
    from onedemo.vision.mask_hints import read_box

    if others:
        raise UserError(
            f"a demo is made of one video, got {1 + len(others)} files; if they are pictures, make a video "
            "of them first: ffmpeg -framerate 30 -i %04d.png -pix_fmt yuv420p y.mp4"
        )
    try:
        rectangle = read_crop(crop) if crop is not None else None
    except ValueError as error:
        raise UserError(f"argument --crop: {error}") from None
    try:
        marked = read_box(box) if box is not None else None
    except ValueError as error:
        raise UserError(f"argument --box: {error}") from None
    demos_dir = data_dir / "demos"
    check_data_dir(demos_dir)
    added = import_video(
        video, name=name, demos_dir=demos_dir, start=start, end=end, crop=rectangle, mirror=mirror, fps=fps,
        speed=read_speed(speed), reverse=reverse, loop=read_loop(loop), rotate=read_rotation(rotate),
        track=track, stabilise=stabilise, warn=lambda said: print(f"onedemo: {said}", file=sys.stderr),
    )  # fmt: skip
    if added.name != name:
        print(f"this video with these options is known already, as {added.name}")
    print(f"{added.name}: {added.seconds:.1f} s, {added.frames} frames, {added.width}x{added.height}")
    if added.edits:
        print(f"done to the video: {added.edits}")
    print(f"what moves: {in_words(find_and_keep(added, marked and hints_of_box(added, *marked)))}")
    print(f"learn it with: onedemo serve --demo {added.name} --data-dir {data_dir}")


@demo.command(name="list")
def list_(*, data_dir: DataDir = DATA) -> None:
    """The demos there are."""
    from onedemo.demos.library import list_demos

    for each in list_demos(data_dir / "demos"):
        done = f" ({each.edits})" if each.edits else ""
        print(f"{each.name:24} {each.seconds:5.1f} s  {each.width}x{each.height}  {each.source}{done}")


@demo.command
def show(name: str, /, *, data_dir: DataDir = DATA) -> None:
    """What is known of a demo."""
    from onedemo.demos.library import find_demo, show
    from onedemo.vision.mask_file import in_words, kept_masks

    found = find_demo(name, data_dir / "demos")
    print(show(found))
    if (masks := kept_masks(found)) is not None:
        print(f"moves   {in_words(masks)}")


@demo.command
def rename(old: str, new: str, /, *, data_dir: DataDir = DATA) -> None:
    """Give a demo another name; its runs go on.

    Args:
        old: Its name.
        new: What to call it.
    """
    from onedemo.app.services.demo_shelf import rename

    with _store(data_dir) as store:
        rename(store, data_dir, old, new)
    print(f"{old} is called {new} now")


@demo.command
def remove(name: str, /, *, data_dir: DataDir = DATA) -> None:
    """Delete a demo that no run learns from.

    Args:
        name: Its name.
    """
    from onedemo.app.services.demo_shelf import remove

    with _store(data_dir) as store:
        remove(store, data_dir, name)
    print(f"{name} is deleted")


@contextmanager
def _store(data_dir: Path) -> Iterator[Store | None]:
    """The database, if there is one."""
    from onedemo.storage.database import FILE_NAME
    from onedemo.storage.store import Store

    if not (data_dir / FILE_NAME).exists():
        yield None
        return
    store = Store(data_dir)
    try:
        yield store
    finally:
        store.close()
