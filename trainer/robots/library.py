"""A person's own robots: ``robots/<hash>/`` of a data directory.

``model/`` holds a copy of the MJCF and of all that it needs, ``<name>.json`` what was chosen: one for each
robot of that model. The hash is of the copy, so that nobody changes a model that runs were made with, and the
same model is kept once. The directory is renamed into place when it is whole.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from onedemo.core.directories import Workshop, make_directory, sync_directory
from onedemo.core.files import write_atomic
from onedemo.core.names import check_name, check_new_name
from onedemo.errors import UserError
from onedemo.robots.camera import Camera, chosen_camera
from onedemo.robots.model_files import MOST_BODIES, copy_model, files_of, hash_of
from onedemo.robots.robot import (
    Robot,
    Root,
    Wild,
    body_name,
    build,
    floor_of,
    model_of,
    moving_bodies,
    plane_of,
    root_of,
    solid_geoms,
)

_STEP = 1 / 80
"""Control step that is aimed at, seconds: between 1/100 and 1/60."""
_LONGEST_STEP = 0.1
_MOST_MOTORS, _MOST_PLACES = 128, 512
_FASTEST_SEEN = 100.0
"""Observed velocities are clipped to that, m/s and rad/s."""
_TOUCHING, _FAR = 0.01, 100.0
"""Metres above the lowest part within which others count as standing on the floor, too; of no floor."""


def add_robot(
    model: Path, data_dir: Path, *, name: str, folder: Path | None = None, control_step: float | None = None,
    root: Root | None = None, keypoints: Sequence[str] | None = None, feet: Sequence[str] | None = None,
    camera: str | None = None,
) -> Robot:  # fmt: skip
    """Copies a model into the data directory and makes a robot of it; rules choose what is not given.

    Args:
        model: Its MJCF file.
        data_dir: Everything is kept there.
        name: What to call it.
        folder: What holds the model and all that it needs; the model's own directory if None.
        control_step: Seconds between two actions, a multiple of the model's timestep.
        root: How its first body moves.
        keypoints: Bodies that are drawn and compared.
        feet: Those of them that touch the ground while it stands.
        camera: As ``read_camera``.

    Returns:
        The robot, kept.

    Raises:
        UserError: If the model or a choice cannot be used, or the name is taken; nothing is then kept.
    """
    check_new_name(check_name(name))
    files = files_of(model, folder)
    place = data_dir / "robots"
    try:
        make_directory(place, private=True)
        with Workshop(place, ".robot-") as workshop:
            sha256 = copy_model(files, workshop / "model")
            copied = workshop / "model" / next(iter(files))
            robot = choose(
                copied,
                name,
                control_step=control_step,
                root=root,
                keypoints=keypoints,
                feet=feet,
                camera=camera,
            )
            kept = place / sha256
            robot = replace(robot, xml=kept / "model" / next(iter(files)), model_sha256=sha256)
            for known, file in robots_in(data_dir):
                if known == name and file != kept / f"{name}.json":
                    raise UserError(f"there is a robot {name} already, of another model; choose another name")
            text = json.dumps(_chosen(robot, next(iter(files))), indent=1).encode() + b"\n"
            if (about := kept / f"{name}.json").exists() and about.read_bytes() != text:
                raise UserError(f"there is a robot {name} already, with other choices; choose another name")
            if not kept.exists():
                write_atomic(workshop / f"{name}.json", text)
                for directory, _, _ in os.walk(workshop):
                    sync_directory(Path(directory))
                os.replace(workshop, kept)
                sync_directory(place)
            elif not about.exists():
                write_atomic(about, text)
    except OSError as error:
        raise UserError(f"cannot keep the robot in {place}: {error.strerror}") from None
    return robot


def robots_in(data_dir: Path) -> Iterator[tuple[str, Path]]:
    """(name, file that says what was chosen) of each robot of a data directory, in the order of the names."""
    files = [file for file in (data_dir / "robots").glob("*/*.json") if not file.parent.name.startswith(".")]
    yield from sorted((file.stem, file) for file in files)


def own_robot(name: str, data_dir: Path) -> Robot | None:
    """The robot of that name; None if there is none.

    Raises:
        UserError: If it is damaged.
    """
    file = next((file for known, file in robots_in(data_dir) if known == name), None)
    return load_robot(file) if file is not None else None


def load_robot(file: Path) -> Robot:
    """A robot of what was chosen for it.

    The file and the model may be from somebody else's backup: they are checked as they were when added.

    Raises:
        UserError: If the model is not what it was, or the file does not say what is needed.
    """
    name, kept = file.stem, file.parent
    try:
        about = json.loads(file.read_bytes())
        xml = kept / "model" / about.pop("model")
        if hash_of(files_of(xml, kept / "model")) != kept.name:
            raise ValueError("its model is not what was added")
        _compile(xml)
        for key, kind in (("camera", Camera), ("wild", Wild)):
            about[key] = kind(**_tuples(about[key]))
        return build(check_name(name), xml, model_sha256=kept.name, **_tuples(about))
    except (UserError, ValueError, TypeError, KeyError, AttributeError, OSError) as error:
        raise UserError(f"robot {name} is damaged ({error}): delete {kept} and add it again") from None


def copy_robot(file: Path, data_dir: Path) -> None:
    """Takes a robot of another data directory into this one, unless it is there.

    Args:
        file: What was chosen for it, as ``robots_in`` gives it; its model is beside it.
        data_dir: Where to.

    Raises:
        UserError: If it is damaged, or another robot is called so.
    """
    robot = load_robot(file)
    if (there := own_robot(robot.name, data_dir)) is not None and there.sha256 != robot.sha256:
        raise UserError(f"there is a robot {robot.name} already, and it is another than {file.parent}")
    if there is not None:
        return
    place, model = data_dir / "robots", file.parent / "model"
    kept = place / robot.model_sha256
    make_directory(place, private=True)
    with Workshop(place, ".robot-") as workshop:
        if not kept.exists():
            copy_model(files_of(robot.xml, model), workshop / "model")
            os.replace(workshop, kept)
        write_atomic(kept / file.name, file.read_bytes())
        sync_directory(place)


def remove_robot(name: str, data_dir: Path) -> None:
    """Deletes a robot, and its model with the last robot of it.

    Raises:
        UserError: If there is none.
    """
    file = next((file for known, file in robots_in(data_dir) if known == name), None)
    if file is None:
        raise UserError(f"there is no robot {name} of your own in {data_dir}")
    if len(list(file.parent.glob("*.json"))) > 1:
        file.unlink()
        return
    with Workshop(file.parent.parent, ".robot-") as away:
        os.replace(file.parent, away / "robot")
        shutil.rmtree(away / "robot")


def choose(
    xml: Path, name: str, *, control_step: float | None = None, root: Root | None = None,
    keypoints: Sequence[str] | None = None, feet: Sequence[str] | None = None, camera: str | None = None,
) -> Robot:  # fmt: skip
    """A robot of a model, as ``add_robot``, which is not copied.

    Raises:
        UserError: If the model or a choice cannot be used.
    """
    model = _compile(xml)
    data = mujoco.MjData(model)
    if model.nkey:  # the pose that its maker thought of
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    kind, seen, floor = _root(model, root), moving_bodies(model), floor_of(model)
    names = [body_name(model, body) for body in seen]
    limbs = _named(keypoints, names, "keypoint")
    gaps = dict(zip(names, (_gap(model, data, body) for body in seen), strict=True))
    standing = min(gaps.values()) + _TOUCHING if kind != "fixed" and floor is not None else -np.inf
    middle, reach = _extent(model, data, seen)
    robot = build(
        name, xml, frame_skip=_frame_skip(model, control_step), root=kind, limbs=limbs,
        feet=_named(feet, list(limbs), "foot") if feet else tuple(n for n in limbs if gaps[n] < standing),
        rest=tuple(data.qpos.tolist()), velocity_limit=_FASTEST_SEEN,
        camera=_camera(camera, chosen_camera(model, kind), _planes(model, kind), middle, reach),
    )  # fmt: skip
    if robot.height is None:
        return robot
    up = float(data.xpos[model.jnt_bodyid[0], 2])  # of the root at rest
    low, high = (up - reach, up + reach) if floor is None else (floor + 0.1 * reach, up + reach)
    shift = float(data.qpos[robot.height]) - up  # a slide counts from where the model has it
    return replace(robot, wild=Wild(heights=(low + shift, high + shift)))


def _camera(
    text: str | None, chosen: Camera, planes: Sequence[str], middle: np.ndarray, reach: float
) -> Camera:
    """The camera of ``PLANE[,DISTANCE[,HEIGHT]]``, as "xz,3,0.9": seen with x to the right and z up, metres.

    Args:
        text: What was typed; None for nothing.
        chosen: By the model; it holds where nothing else is said.
        planes: Those that the robot can be seen in.
        middle: Of the robot at rest, (3,), metres.
        reach: How far it reaches from there, metres.

    Raises:
        UserError: If it says something else.
    """
    if text is None:
        return chosen
    plane, *words = text.split(",")
    try:
        numbers = [float(word) for word in words]
        if (
            plane not in planes
            or len(numbers) > 2
            or not np.isfinite(numbers).all()
            or (numbers and numbers[0] <= 0)
        ):
            raise ValueError
    except ValueError:
        raise UserError(
            f"a camera is PLANE[,DISTANCE[,HEIGHT]], as {planes[0]},{chosen.distance:g},{chosen.height:g}; "
            f"this robot is seen in the plane {' or '.join(planes)}, got {text!r}"
        ) from None
    right, up = ("xyz".index(axis) for axis in plane)
    if (right, up) != (chosen.right, chosen.up):
        x, y, depth = (round(float(middle[axis]), 3) for axis in (right, up, 3 - right - up))
        chosen = replace(
            chosen, right=right, up=up, distance=round(3 * reach, 3), depth=depth,
            height=y - chosen.floor if up == 2 else y, middle=0.0 if chosen.follows else x,
        )  # fmt: skip
    distance, height = (*numbers, *(chosen.distance, chosen.height)[len(numbers) :])
    return replace(chosen, distance=distance, height=height)


def _compile(xml: Path) -> mujoco.MjModel:
    """The model, if a robot can be made of it."""
    try:
        model = model_of(xml)
    except ValueError as error:
        words = " ".join(str(error).replace(f"{xml.parent}/", "").split())
        raise UserError(f"MuJoCo cannot compile {xml.name}: {words}") from None
    for count, most, what in (
        (model.nbody - 1, MOST_BODIES, "bodies"), (model.nu, _MOST_MOTORS, "actuators"),
        (model.nq, _MOST_PLACES, "positions"),
    ):  # fmt: skip
        if count > most:
            raise UserError(f"{xml.name} has {count:,} {what}, more than {most}")
    if not model.nv or not moving_bodies(model):
        raise UserError(f"{xml.name} has no body that can be seen and can move: give one a joint and a geom")
    if not model.nu:
        raise UserError(
            f"{xml.name} has no actuator, so nothing could make it move: add an <actuator> with a motor or "
            "position servo for each joint that is driven"
        )
    return model


def _root(model: mujoco.MjModel, wanted: Root | None) -> Root:
    found = root_of(model)
    if wanted in (None, "fixed", found):
        return wanted or found
    raise UserError(
        f"the root of this robot is {found}, or fixed, and not {wanted}: free is a freejoint that comes "
        "first, planar is two slides along world axes and a hinge about the third"
    )


def _planes(model: mujoco.MjModel, root: Root) -> list[str]:
    """The planes of the world that the robot can be seen in."""
    if root == "planar":
        return ["".join("xyz"[axis] for axis in sorted(plane_of(model)))]
    return ["xz", "yz", "xy"]


def _frame_skip(model: mujoco.MjModel, wanted: float | None) -> int:
    """Physics steps in a control step."""
    step = float(model.opt.timestep)
    if wanted is None:
        return max(1, round(_STEP / step))
    count = round(wanted / step) if np.isfinite(wanted) else 0
    if count < 1 or abs(count * step - wanted) > 1e-3 * wanted or wanted > _LONGEST_STEP:
        near = max(1, min(round(_LONGEST_STEP / step), count))
        raise UserError(
            f"a control step is a multiple of the model's timestep {step:g} s, up to {_LONGEST_STEP:g} s, as "
            f"{near * step:g}; got {wanted:g}"
        )
    return count


def _named(wanted: Sequence[str] | None, there: list[str], what: str) -> tuple[str, ...]:
    """Those of the names that were asked for, in the order of the model; all if none were."""
    if wanted is None:
        return tuple(there)
    for name in wanted:
        if name not in there:
            raise UserError(f"there is no {what} {name!r}; choose from: {', '.join(there)}")
    if not wanted:
        raise UserError(f"at least one {what} is needed; choose from: {', '.join(there)}")
    return tuple(name for name in there if name in wanted)


def _extent(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> tuple[np.ndarray, float]:
    """Middle of the robot at rest, (3,), and how far it reaches from there, metres."""
    geoms = np.concatenate([solid_geoms(model, body) for body in bodies])
    places, sizes = data.geom_xpos[geoms], model.geom_rbound[geoms, None]
    middle = ((places - sizes).min(axis=0) + (places + sizes).max(axis=0)) / 2
    return middle, float((np.linalg.norm(places - middle, axis=1) + sizes[:, 0]).max())


def _gap(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """How far a body is from the floor, metres."""
    floors = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    gaps = [
        mujoco.mj_geomDistance(model, data, floor, geom, _FAR, None)
        for floor in floors for geom in solid_geoms(model, body)
    ]  # fmt: skip
    return min(gaps, default=_FAR)


def _chosen(robot: Robot, model: str) -> dict[str, Any]:
    """What a robot's file says: all that the model does not say."""
    keys = ("root", "frame_skip", "limbs", "feet", "rest", "velocity_limit", "camera", "wild")
    return {"model": model, **{key: value for key, value in asdict(robot).items() if key in keys}}


def _tuples(value: Any) -> Any:
    """Lists of a JSON file as tuples, all the way down."""
    if isinstance(value, dict):
        return {key: _tuples(inner) for key, inner in value.items()}
    return tuple(_tuples(inner) for inner in value) if isinstance(value, list) else value
