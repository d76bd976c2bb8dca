"""The commands for demonstration videos: ``demo add``, ``list``, ``show``, ``rename``, ``remove``."""

from __future__ import annotations

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
    crop: str | None = None, mirror: bool = False, fps: float = 30.0, data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """Bring in a video.

    Args:
        video: Any video file that FFmpeg decodes: mp4, mov, webm, mkv, avi, gif and many more.
        others: None: a demo is made of one video.
        name: What to call it.
        start: Begin at this second.
        end: End at this second.
        crop: Keep this rectangle: X,Y,W,H in pixels.
        mirror: Swap left and right.
        fps: Frames per second to keep.
    """
    from onedemo.demos.import_checks import read_crop
    from onedemo.demos.library import import_video

    if others:
        raise UserError(
            f"a demo is made of one video, got {1 + len(others)} files; if they are pictures, make a video "
            "of them first: ffmpeg -framerate 30 -i %04d.png -pix_fmt yuv420p y.mp4"
        )
    try:
        rectangle = read_crop(crop) if crop is not None else None
    except ValueError as error:
        raise UserError(f"argument --crop: {error}") from None
    demos_dir = data_dir / "demos"
    check_data_dir(demos_dir)
    added = import_video(
        video, name=name, demos_dir=demos_dir, start=start, end=end, crop=rectangle, mirror=mirror, fps=fps
    )
    if added.name != name:
        print(f"this video with these options is known already, as {added.name}")
    print(f"{added.name}: {added.seconds:.1f} s, {added.frames} frames, {added.width}x{added.height}")
    print(f"learn it with: onedemo serve --demo {added.name} --data-dir {data_dir}")


@demo.command(name="list")
def list_(*, data_dir: DataDir = DATA) -> None:
    """The demos there are."""
    from onedemo.demos.library import list_demos

    for each in list_demos(data_dir / "demos"):
        print(f"{each.name:24} {each.seconds:5.1f} s  {each.width}x{each.height}  {each.source}")


@demo.command
def show(name: str, /, *, data_dir: DataDir = DATA) -> None:
    """What is known of a demo."""
    from onedemo.demos.library import find_demo, show

    print(show(find_demo(name, data_dir / "demos")))


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
