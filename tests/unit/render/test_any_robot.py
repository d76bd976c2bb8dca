"""Robots of every kind as people see them: whole, followed, limbs told apart, whatever their geoms."""

from functools import partial
from operator import attrgetter

import mujoco
import numpy as np
import pytest

from helpers.paths import ROOT
from onedemo.render.clip_image import read_about
from onedemo.render.drawing_process import DrawingProcess
from onedemo.render.framing import clip_sides, marks
from onedemo.render.outline import _surface
from onedemo.render.render_thread import RenderThread
from onedemo.render.renderer import HEIGHT, WIDTH, Renderer
from onedemo.render.stage import Stage
from onedemo.render.studio import chains, colours_of, studio_model
from onedemo.robots.camera import Camera, Extents, chosen_camera, visible_geoms
from onedemo.robots.registry import BUILT_IN, robot_named
from onedemo.robots.robot import build, model_of, root_of
from onedemo.sim.vector_env import RobotVectorEnv
from onedemo.training.pictures import draw_clip, draw_strip

ARM = build("arm", ROOT / "tests/data/arm.xml", frame_skip=5)
ROBOTS = [*map(robot_named, sorted(BUILT_IN)), ARM]
every_robot = pytest.mark.parametrize("robot", ROBOTS, ids=[robot.name for robot in ROBOTS])


def rest(robot, **moved):
    """The robot at rest, (1, q), with some positions changed by number."""
    qpos = model_of(robot.xml).qpos0.copy()
    for index, value in moved.items():
        qpos[int(index[1:])] += value
    return qpos[None]


def limbs(picture):
    """Left, top, right, bottom of what has a strong colour, as neither sky nor floor; and where that is."""
    solid = picture.max(axis=2).astype(int) - picture.min(axis=2) > 60
    rows, columns = np.nonzero(solid)
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]), solid


def moves(robot, count, seed=0):
    """What a robot does under actions that change twice a second, (count, q)."""
    env, rng = RobotVectorEnv(robot, 1, nthread=0), np.random.default_rng(seed)
    env.reset(seed=seed)
    seen = []
    for step in range(count):
        if step % max(1, round(0.5 / robot.dt)) == 0:
            action = rng.uniform(-1, 1, (1, robot.action_size)).astype(np.float32)
        seen.append(env.qpos[0].copy())
        env.step(action)
    return np.array(seen)


# --- from where ---------------------------------------------------------------------------------------


def test_the_hopper_is_seen_as_ever():
    assert robot_named("hopper").camera == Camera(right=0, up=2, distance=3.0, height=0.88, follows=True)
    assert robot_named("hopper").camera.unit == robot_named("hopper").camera.size == 1.0


@every_robot
def test_which_way_a_robot_is_seen_follows_from_how_it_moves(robot):
    camera = robot.camera
    assert camera.follows == (robot.root != "fixed")
    assert (camera.right, camera.up) == ((0, 1) if robot.name == "swimmer" else (0, 2))
    assert chosen_camera(model_of(robot.xml), root_of(model_of(robot.xml))).up == camera.up


@pytest.mark.seam
@every_robot
def test_at_rest_it_is_seen_whole_and_takes_a_third_to_two_thirds_of_the_picture(robot):
    with Renderer(robot=robot) as renderer:
        (left, top, right, bottom), _ = limbs(renderer.render(rest(robot))[0])
    assert 0 < left and 0 < top and right < WIDTH and bottom < HEIGHT
    assert (
        0.33 < max((bottom - top) / HEIGHT, (right - left) / WIDTH) < (0.9 if robot.root == "fixed" else 0.72)
    )


@pytest.mark.seam
def test_all_that_an_arm_can_reach_is_in_the_picture():
    rng, model = np.random.default_rng(1), model_of(ARM.xml)
    poses = rng.uniform(*model.jnt_range.T, (60, model.nq))
    with Renderer(robot=ARM) as renderer:
        for picture in renderer.render(poses):
            (left, top, right, _), _ = limbs(picture)  # it may dip below the floor
            assert left > 0 and top > 0 and right < WIDTH


@pytest.mark.seam
@pytest.mark.parametrize(
    ("name", "moved"),
    [("walker2d", {"q0": 7.3}), ("ant", {"q0": 5.2, "q1": -3.4}), ("swimmer", {"q0": 4.4, "q1": 9.1})],
)
def test_a_robot_that_goes_away_is_followed_and_the_floor_goes_by(name, moved):
    robot = robot_named(name)
    with Renderer(robot=robot) as renderer:
        here, there = (renderer.render(rest(robot, **shift))[0].astype(int) for shift in ({}, moved))
    box, solid = limbs(here)
    other, _ = limbs(there)
    assert np.abs(box - other).max() <= 1
    assert np.abs(here - there)[~solid].max() > 8


def test_a_wall_before_a_robot_is_left_out_and_one_behind_it_stays(tmp_path):
    walls = '<geom name="{}" type="box" size="1 .05 1" pos="0 {} 1"/>'
    scene = (ROOT / "tests/data/arm.xml").read_text()
    for name, y, seen in (("before", -0.6, 0), ("behind", 0.6, 1)):
        file = tmp_path / f"{name}.xml"
        file.write_text(scene.replace("<worldbody>", "<worldbody>" + walls.format(name, y)))
        model = studio_model(build(name, file, frame_skip=5), width=64, height=48)
        assert model.geom(name).rgba[3] == seen


# --- how far geoms reach ------------------------------------------------------------------------------


def test_extents_hold_every_kind_of_geom_and_little_more():
    model = model_of(ARM.xml)
    data, geoms, rng = mujoco.MjData(model), visible_geoms(model), np.random.default_rng(2)
    extents = Extents(model, geoms)
    assert len({int(kind) for kind in model.geom_type[geoms]}) == 6
    for _ in range(20):
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        for geom, low, high in zip(geoms, *extents.of(data), strict=True):
            points = _surface(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            assert (low - 1e-6 <= points.min(axis=0)).all() and (points.max(axis=0) <= high + 1e-6).all()
            slack = 0.35 if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH else 0.07
            assert ((high - low) * (1 - slack) <= np.ptp(points, axis=0) + 1e-6).all()


@every_robot
def test_an_outline_is_as_large_as_the_robot(robot):
    model = studio_model(robot, width=64, height=48)
    stage, data = Stage(robot, model), mujoco.MjData(model)
    shape = stage.pose(data, rest(robot)[0])
    border = stage.outline(data)
    fine = 4 * robot.camera.size / 160 + 0.02 * robot.camera.size
    assert np.abs(border.min(axis=0) - shape.low[:, [0, 2]].min(axis=0)).max() < fine
    assert np.abs(border.max(axis=0) - shape.high[:, [0, 2]].max(axis=0)).max() < fine


# --- colours ------------------------------------------------------------------------------------------

# fmt: off
_BLIND = {  # Machado et al. 2009, complete, on linear RGB
    "no red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
}


@pytest.mark.parametrize("sight", ["full", *_BLIND])
@every_robot
def test_like_limbs_of_both_sides_are_told_apart_by_colour_blind_people_too(robot, sight):
    model = model_of(robot.xml)
    colours, places = colours_of(robot, model), chains(model, robot.root)
    seen = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    if sight != "full":
        seen = np.clip(seen @ np.array(_BLIND[sight]).T, 0, 1)
    first = {body: seen[int(np.flatnonzero(model.geom_bodyid == body)[0])] for body in places}
    for one, (chain, place) in places.items():
        for other, (another, there) in places.items():
            if one < other and place == there and chain != another and -1 not in (chain, another):
                assert np.abs(first[one] ** 0.4 - first[other] ** 0.4).max() > 0.08, (one, other)


def test_the_hopper_keeps_its_colours():
    robot = robot_named("hopper")
    found = colours_of(robot, model_of(robot.xml))[1:]
    assert np.allclose(found, [(0.91, 0.29, 0.17), (0.13, 0.25, 0.47), (0.2, 0.48, 0.76), (0.97, 0.69, 0.15)])


# --- clips, strips, whoever draws them ----------------------------------------------------------------


@pytest.mark.seam
@every_robot
def test_a_clip_shows_the_whole_robot_with_its_marks_on_it(robot, tmp_path):
    qpos = moves(robot, round(1.2 / robot.dt))[:: max(1, round(1 / 30 / robot.dt))][-9:]
    film = np.full((9, HEIGHT, WIDTH, 3), 128, np.uint8)
    with Renderer(robot=robot, exact=False) as renderer:
        _, side = clip_sides(renderer, film, None, [qpos])
        draw_strip(renderer, file=tmp_path / "strip.jpg", qpos=qpos)
    tall, wide = side.pictures.shape[1:3]
    known = side.known
    metre = wide / known["width"]
    for frame, picture in enumerate(side.pictures):
        (left, top, right, bottom), _ = limbs(picture)
        assert 0 < left and 0 < top and right < wide and bottom < tall
        low = known["bottom"][frame] if robot.camera.up != 2 else known["bottom"]
        for _, path in known["marks"]:
            x, y = (path[frame][0] - known["left"][frame]) * metre, tall - (path[frame][1] - low) * metre
            # Off its plane perspective moves it a little.
            assert (
                left - 0.12 * wide < x < right + 0.12 * wide and top - 0.12 * tall < y < bottom + 0.12 * tall
            )
    assert len(known["ghost"]) > 3
    assert ("camera" in known) == (robot.camera.up == 2)  # from above there are no heights


def test_what_is_marked_of_each_robot():
    words = {robot.name: [word for word, _ in marks(robot, rest(robot))] for robot in ROBOTS}
    assert words == {
        "hopper": ["Head", "Foot"], "walker2d": ["Head", "Foot", ""], "half-cheetah": ["Head", "Foot", ""],
        "humanoid": ["Head", "Foot", ""], "ant": ["Head", "Foot", "", "", ""], "swimmer": ["Head", "Tail"],
        "arm": ["Tip"],
    }  # fmt: skip
    head, *feet = (place[0] for _, place in marks(robot_named("walker2d"), rest(robot_named("walker2d"))))
    assert head[1] > 1.2 and all(foot[1] < 0.2 for foot in feet)


@pytest.mark.seam
def test_one_thread_draws_several_robots_each_by_its_own_renderer(monkeypatch):
    poses = {robot.name: rest(robot) for robot in ROBOTS}
    made = {}
    with RenderThread(64, 48, robot=ARM) as drawing:
        for robot in (ARM, ROBOTS[0], ROBOTS[-2], ARM):  # of three, two are kept
            draw = partial(Renderer.render, qpos_Tq=poses[robot.name])
            picture = drawing.submit(draw, robot=robot).result(60)
            assert np.array_equal(made.setdefault(robot.name, picture), picture)
        assert isinstance(drawing.render(poses["ant"]).exception(60), ValueError)
        assert len(drawing._renderers) == 2


@pytest.mark.seam
def test_the_drawing_process_is_told_whose_positions_it_draws(tmp_path):
    name_of = attrgetter("robot.name")
    with DrawingProcess() as process:
        assert process.submit(name_of).result(60) == "hopper"
        assert process.submit(name_of, robot=ARM).result(60) == "arm"
        assert process.submit(name_of, robot=robot_named("ant")).result(60) == "ant"


@pytest.mark.seam
def test_a_clip_beside_a_film_of_the_same_robot_has_one_scale(tmp_path):
    from onedemo.demos.library import render_demo

    robot = robot_named("walker2d")
    qpos = moves(robot, 200, seed=3)
    demo = render_demo(qpos, name="steps", task="", source="a test", out_dir=tmp_path, robot=robot)
    assert demo.robot == "walker2d"
    file, frames = tmp_path / "clip.jpg", np.arange(10, 19)
    steps = np.round(frames / 30 / robot.dt).astype(int)
    with Renderer(robot=robot, exact=False) as renderer:
        draw_clip(renderer, file=file, demo=demo, frames=frames, robots=[qpos[steps]])
    film, drawn = read_about(file.read_bytes())["sides"]
    assert film["width"] == drawn["width"] and film["camera"] == drawn["camera"]
