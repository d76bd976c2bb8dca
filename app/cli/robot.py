"""The commands for robots: ``robot add``, ``list``, ``show``, ``render``, ``remove``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import App

from onedemo.app.cli.data import DATA, DataDir, Whole, check_output, written
from onedemo.errors import UserError

if TYPE_CHECKING:
    from onedemo.robots.robot import Robot

robot = App(name="robot", help="Bring in and look at robots: any MuJoCo model.")


@robot.command
def add(
    model: Path, /, *, name: str, control_step: float | None = None,
    root: Literal["free", "planar", "fixed"] | None = None, camera: str | None = None,
    keypoints: str | None = None, feet: str | None = None, folder: Path | None = None,
    data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """Bring in a robot; what is not said is chosen by its model.

    Args:
        model: Its MJCF file; meshes, textures and includes are taken along.
        name: What to call it.
        control_step: Seconds between two actions, a multiple of the model's timestep.
        root: How its first body moves; fixed, and the camera stands still.
        camera: PLANE[,DISTANCE[,HEIGHT]], as xz,3,0.9: x to the right, z up, metres.
        keypoints: Bodies that are drawn and compared, as torso,thigh,leg.
        feet: Those of them on which it stands.
        folder: What holds the model and its files [default: where the model is].
    """
    from onedemo.core.outputs import check_data_dir
    from onedemo.robots.library import add_robot
    from onedemo.robots.registry import BUILT_IN

    if name in BUILT_IN:
        raise UserError(f"{name} comes with the program; choose another name")
    check_data_dir(data_dir / "robots")
    added = add_robot(
        model, data_dir, name=name, folder=folder, control_step=control_step, root=root,
        keypoints=_names(keypoints), feet=_names(feet), camera=camera,
    )  # fmt: skip
    _say(added)
    print(f"teach it with: onedemo serve --robot {name} --demo DEMO --data-dir {data_dir}")


@robot.command(name="list")
def list_(*, data_dir: DataDir = DATA) -> None:
    """The robots there are."""
    from onedemo.robots import registry

    registry.use(data_dir)
    for name in registry.names():
        try:
            each = registry.robot_named(name)
        except UserError as error:
            print(f"{name:24} {error}")
            continue
        origin = "comes with the program" if name in registry.BUILT_IN else each.xml.name
        print(
            f"{name:24} {each.root:6}  {each.action_size:3} actions  {len(each.limbs):3} keypoints  {origin}"
        )


@robot.command
def show(name: str, /, *, data_dir: DataDir = DATA) -> None:
    """What is known of a robot, and what was chosen for it.

    Args:
        name: Its name, or gym:ID.
    """
    _say(_named(name, data_dir))


@robot.command
def render(
    name: str, /, out: Path, *, count: Whole = 6, seed: Whole = 0, data_dir: DataDir = DATA
) -> None:  # fmt: skip
    """Write a picture of the robot: standing first, then in random states.

    Args:
        name: Its name, or gym:ID.
        out: The picture, PNG or JPEG.
        count: How many states.
        seed: Of the random states.
    """
    from onedemo.app.services.robot_picture import robot_picture
    from onedemo.core.files import write_atomic

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise UserError(f"the picture must end in .png or .jpg, got {out}")
    if not 1 <= count <= 60:
        raise UserError(f"--count must be 1 to 60, got {count}")
    check_output(out, data_dir)
    drawn = robot_picture(_named(name, data_dir), count, seed=seed, suffix=out.suffix.lower())
    with written():
        write_atomic(out, drawn)
    print(f"{out}: {name} at rest and in {count - 1} random states")


@robot.command
def remove(name: str, /, *, data_dir: DataDir = DATA) -> None:
    """Delete a robot that no run learns with.

    Args:
        name: Its name.
    """
    import tomllib

    from onedemo.app.cli.data import open_store
    from onedemo.robots.library import remove_robot
    from onedemo.storage.database import FILE_NAME

    if (data_dir / FILE_NAME).exists():
        with open_store(data_dir) as store:
            runs = [r["id"] for r in store.runs.all() if tomllib.loads(r["config"]).get("env") == name]
        if runs:
            raise UserError(f"{', '.join(runs)} learns with robot {name}; it stays as long as they do")
    remove_robot(name, data_dir)
    print(f"{name} is deleted")


def _named(name: str, data_dir: Path) -> Robot:
    from onedemo.robots import registry

    registry.use(data_dir)
    return registry.robot_named(name)


def _names(text: str | None) -> list[str] | None:
    return [word.strip() for word in text.split(",")] if text is not None else None


def _say(robot: Robot) -> None:
    """What a robot is, a line each."""
    camera, seen = robot.camera, robot.positions - robot.unseen
    moves = {"free": "moves freely", "planar": "moves in a plane", "fixed": "stands fast"}[robot.root]
    follows = "follows it" if camera.follows else "stands still"
    ranges = ", ".join(f"{low:g}..{high:g}" for low, high in zip(robot.low, robot.high, strict=True))
    for key, value in (
        ("name", robot.name),
        ("model", robot.xml),
        ("root", f"{robot.root}: it {moves}, the camera {follows}"),
        ("control step", f"{robot.dt:g} s, {robot.frame_skip} of the model's {robot.timestep:g} s"),
        ("actions", f"{robot.action_size}, -1..1 for {ranges}"),
        ("observation", f"{robot.obs_size}: {seen} positions, {robot.velocities} velocities"),
        ("keypoints", ", ".join(robot.limbs)),
        ("feet", ", ".join(robot.feet) or "none"),
        ("camera", f"{'xyz'[camera.right]}{'xyz'[camera.up]},{camera.distance:g},{camera.height:g}"),
        ("hash", robot.model_sha256 or robot.sha256),
    ):
        print(f"{key:13} {value}")
