"""``onedemo bench pose``: how well a robot's pose is read from others' videos of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from onedemo.experiments.jobs.pose import HOW, TRUE
from onedemo.experiments.jobs.pose_looks import GYMNASIUM, LOOKS
from onedemo.experiments.report.blocks import Block, Bullets, Heading, Table, Text
from onedemo.experiments.runner import Job
from onedemo.experiments.tables import parts
from onedemo.experiments.tables.parts import Goal, Groups, Pick

ROBOTS = ("hopper",)
_LEAST = {"directions": 0.9, "height": 0.8, "travel": 0.6}
"""R2 to be reached."""


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """A job for each robot, look and seed."""
    sizes = {"seconds": 2.0, "films": 2} if quick else {"seconds": 4.0, "films": 6}
    return [
        Job(
            kind="pose",
            label=_label(robot, look),
            settings={"robot": robot, "look": look, **sizes},
            seed=seed,
        )
        for seed in seeds
        for robot in ROBOTS
        for look in LOOKS
        if look != "gymnasium" or robot in GYMNASIUM
    ]


def _label(robot: str, look: str) -> str:
    return f"{robot}, {look}"


def _explained(how: str, kind: str) -> Pick:
    """R2 of a kind of number: the mean of them, where there are several."""

    def pick(result: Mapping[str, Any]) -> float | None:
        found = [value for name, value in result[how]["explained"].items() if _kind(name) == kind]
        return sum(found) / len(found) if found else None

    return pick


def _kind(name: str) -> str:
    if name.startswith("rate of "):
        return "rates"
    return name if name in ("height", "travel", "contact") else "directions"


def _named(how: str, name: str) -> Pick:
    return lambda result: result[how][name]


def _least(how: str) -> Pick:
    def pick(result: Mapping[str, Any]) -> float | None:
        return min(v for name, v in result[how]["explained"].items() if _kind(name) == "directions")

    return pick


def _table(groups: Groups) -> Iterable[Block]:
    kinds = ("directions", "height", "travel", "rates", "contact")
    for label, group in groups.items():
        rows = []
        for how in HOW:
            picks = [_named(how, "iou"), *(_explained(how, kind) for kind in kinds)]
            picks[2:2] = [_least(how)]
            picks += [_named(how, "sure"), _named(how, "doubt")]
            rows.append((how, *(parts.mean(pick, group, groups) for pick in picks)))
        heads = ("video", "masks, IoU", "directions", "worst of them", *kinds[1:], "sure", "doubt and error")
        yield Table(title=label, heads=heads, rows=rows)


def _goal(label: str, how: str, kind: str, least: float) -> Goal:
    pick = _explained(how, kind)
    return Goal(
        label=label, what=f"{kind} at least {least:g}: {how}", shown=pick, of_5=5,
        met=lambda result: (pick(result) or 0) >= least,
    )  # fmt: skip


_GOALS = [
    _goal(_label(robot, look), how, kind, least)
    for robot in ROBOTS
    for look in LOOKS
    for how in HOW
    for kind, least in _LEAST.items()
]

TABLE = parts.Experiment(
    title="onedemo: the pose read from videos of the robot that others make", seeds=3, plan=plan,
    parts=[
        Text(
            "Films of states that nothing was trained on: random actions from random and from standing "
            "starts, and parts of the built-in demos. Each is drawn in a look with its own camera, coded and "
            "blurred, brought to 240 columns, searched for the robot, and read by the net that learned from "
            "silhouettes of the robot's own model alone. **True masks** are those that MuJoCo draws for the "
            "same camera, with its true scale, floor and way: what a perfect search would give."
        ),
        Heading("Goals"),
        parts.Goals(_GOALS),
        Heading("R2 of each number"),
        _table,
        Heading("Definitions"),
        Bullets([
            "**R2**: 1 - squared error / variance, over all frames of a seed's films, those included in "
            "which nothing was found. **Directions**: mean over sine and cosine of each limb; **rates**: of "
            "height and directions.",
            "**Sure**: share of frames with a doubt below a half. **Doubt and error**: their rank "
            "correlation over frames.",
            "**Gymnasium** draws its own environment, by its model's camera that follows. **mjviser's "
            "colours**: a drawing by MuJoCo with the colours, camera and floor lines of the live view, since "
            "mjviser itself draws in a browser. **Ours, other colours**: all hues turned by 120 degrees.",
            f"**{TRUE}** are drawn 240 pixels high; scale, floor and way are then exact.",
        ]),
    ],
)  # fmt: skip
