"""The commands for demonstration videos: ``demo add``, ``demo list``, ``demo show``."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from onedemo.app.cli.data import DATA, DataDir
from onedemo.core.outputs import check_data_dir
from onedemo.errors import UserError

demo = App(name="demo", help="Bring in and look at demonstration videos.")


@demo.command
def add(
    video: Path, /, *, name: str, start: float | None = None, end: float | None = None,
    crop: str | None = None, mirror: bool = False, fps: float = 30.0, data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """Bring in a video.

    Args:
        video: Any file that OpenCV decodes: mp4, webm, mov, avi, gif.
        name: What to call it.
        start: Begin at this second.
        end: End at this second.
        crop: Keep this rectangle: X,Y,W,H in pixels.
        mirror: Swap left and right.
        fps: Frames per second to keep.
    """
    from onedemo.demos.import_checks import read_crop
    from onedemo.demos.library import import_video

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
