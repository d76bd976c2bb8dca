"""A person's own models: what is chosen for them, what is copied, and what is refused in a sentence."""

import json
import shutil
from typing import ClassVar

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv

from helpers.paths import ROOT
from onedemo.errors import UserError
from onedemo.rl.random_states import random_states
from onedemo.robots import library, registry
from onedemo.robots.library import add_robot, load_robot, remove_robot, robots_in
from onedemo.robots.model_files import files_of
from onedemo.sim import vector_env
from onedemo.sim.kinematics import body_of

MODELS = ROOT / "tests/data/robots"
OWN = {"arm": "arm.xml", "tendons": "tendons.xml", "crane": "crane/crane.xml", "unstable": "unstable.xml"}


@pytest.fixture
def used(tmp_path):
    registry.use(tmp_path)
    yield tmp_path
    registry.use(None)


@pytest.fixture(params=sorted(OWN))
def own(request, used):
    add_robot(MODELS / OWN[request.param], used, name=request.param)
    return registry.robot_named(request.param)


def written(folder, text, name="robot.xml"):
    (folder / name).write_text(text)
    return folder / name


def legged(inside="", before="", actuator='<motor joint="knee"/>'):
    return (
        f'<mujoco>{before}<worldbody><body name="trunk"><freejoint/><geom size="0.1"/>{inside}'
        '<body name="leg"><joint name="knee"/><geom size="0.1" pos="0 0 -0.2"/></body></body></worldbody>'
        f"<actuator>{actuator}</actuator></mujoco>"
    )


def test_rules_choose_by_the_model(used):
    arm, tendons, crane = (
        add_robot(MODELS / OWN[name], used, name=name) for name in ("arm", "tendons", "crane")
    )
    assert (arm.root, arm.hidden, arm.across, arm.height) == ("fixed", (), None, None)
    assert not arm.camera.follows and (arm.camera.right, arm.camera.up) == (0, 2)
    assert arm.limbs == ("upper", "lower", "hand"), "the base never moves"
    assert arm.low[0] == -1.5 and arm.high[1] == pytest.approx(np.radians(140)), "ranges of servo and joint"
    assert (tendons.root, tendons.hidden, tendons.across, tendons.height) == ("planar", (1,), 1, 0)
    assert tendons.feet == ("back", "front") and tendons.camera.follows
    assert (tendons.low, tendons.high) == ((-40.0, -1.0), (0.0, 1.0))
    assert (crane.root, crane.hidden, crane.across, crane.height) == ("free", (0, 1), 0, 2)
    assert crane.feet == ("left", "right") and crane.rest[2] == 0.2, "it rests in its key frame"
    assert crane.high[2] == 10.0, "what the force of a motor is limited to"
    for robot in (arm, tendons, crane):
        assert 1 / 100 - 1e-9 <= robot.dt <= 1 / 60


def test_a_robot_is_read_back_as_it_was_added(own, used):
    again = load_robot(next(file for name, file in robots_in(used) if name == own.name))
    assert again == own and own.xml.is_relative_to(used) and own.sha256 == again.sha256
    assert own.name in registry.names()
    same = add_robot(MODELS / OWN[own.name], used, name=own.name)
    assert same == own and len(list(robots_in(used))) == 1
    copies = {path.name for path in own.xml.parent.rglob("*") if path.is_file()}
    assert copies == {path.name for path in files_of(MODELS / OWN[own.name]).values()}


def test_it_is_simulated_observed_and_compared_like_any_other(own):
    env = vector_env.make(own.name, 4, nthread=0, horizon=30)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (4, own.obs_size) and env.single_action_space.shape == (own.action_size,)
    np.testing.assert_allclose(env.qpos, np.tile(own.rest, (4, 1)), atol=0.011)
    rng = np.random.default_rng(0)
    qpos, qvel = random_states(4, rng, own.name)
    env.set_states(np.arange(4), qpos, qvel)
    for _ in range(40):
        obs, *_ = env.step(rng.uniform(-1, 1, (4, own.action_size)))
        assert np.isfinite(obs).all()
    body = body_of(own)
    assert body.pose(obs).shape == body.motion(obs).shape == (4, body.pose_size)
    assert np.isfinite(body.pose(obs)).all() and np.isfinite(body.motion(obs)).all()
    back, _ = own.state(own.observe(qpos, qvel))
    kept = np.delete(np.arange(own.positions), own.hidden)
    np.testing.assert_array_equal(back[:, kept], qpos[:, kept])
    env.close()


def test_actions_reach_from_end_to_end_of_the_actuators(used):
    add_robot(MODELS / "arm.xml", used, name="arm")
    env = vector_env.make("arm", 3, nthread=0)
    env.reset(seed=0)
    for _ in range(300):
        env.step(np.array([[-1.0, 0, 0], [0, 0, 0], [0.5, 0, 0]]))
    np.testing.assert_allclose(env.qpos[:, 0], [-1.5, 0, 0.75], atol=0.25)  # it is heavy
    env.close()


@pytest.mark.parametrize("name", ["arm", "tendons", "crane"])
def test_random_states_are_what_such_a_robot_can_be_in(name, used):
    robot = add_robot(MODELS / OWN[name], used, name=name)
    qpos, qvel = random_states(300, np.random.default_rng(0), name)
    body, model = body_of(robot), mujoco.MjModel.from_xml_path(str(robot.xml))
    assert np.minimum.reduce(list(body.clearances(qpos).values())).min() > -0.051
    for joint in np.flatnonzero(model.jnt_limited & (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)):
        low, high = model.jnt_range[joint]
        turned = qpos[:, model.jnt_qposadr[joint]]
        assert (
            low <= turned.min() < low + 0.3 * (high - low)
            and high - 0.3 * (high - low) < turned.max() <= high
        )
    env = vector_env.make(name, 300, nthread=0)
    env.reset(seed=0)
    env.set_states(np.arange(300), qpos, qvel)
    for _ in range(20):
        env.step(np.zeros((300, robot.action_size)))
    assert env.unstable == 0 and np.quantile(np.abs(env.qvel).max(axis=1), 0.9) < 30
    env.close()


def test_choices_can_be_made(used):
    robot = add_robot(
        MODELS / "crane/crane.xml", used, name="slow", control_step=0.02, root="fixed",
        keypoints=["jib", "hull"], feet=["hull"], camera="yz,5,1.5",
    )  # fmt: skip
    assert (robot.frame_skip, robot.root, robot.limbs, robot.feet) == (
        10,
        "fixed",
        ("hull", "jib"),
        ("hull",),
    )
    assert (robot.camera.right, robot.camera.up, robot.camera.distance, robot.camera.height) == (1, 2, 5, 1.5)
    other = add_robot(MODELS / "crane/crane.xml", used, name="quick")
    assert other.model_sha256 == robot.model_sha256 and other.sha256 != robot.sha256
    assert len([path for path in (used / "robots").iterdir()]) == 1, "the model is kept once"
    with pytest.raises(UserError, match="already, with other choices"):
        add_robot(MODELS / "crane/crane.xml", used, name="slow")
    with pytest.raises(UserError, match="already, of another model"):
        add_robot(MODELS / "arm.xml", used, name="slow")
    remove_robot("slow", used)
    assert [name for name, _ in robots_in(used)] == ["quick"] and other.xml.exists()
    remove_robot("quick", used)
    assert not list((used / "robots").iterdir())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"control_step": 0.003}, "multiple of the model's timestep 0.004 s"),
        ({"control_step": float("nan")}, "multiple of the model's timestep"),
        ({"control_step": 3.0}, "up to 0.1 s"),
        ({"keypoints": ["upper", "hnad"]}, "no keypoint 'hnad'; choose from: upper, lower, hand"),
        ({"feet": ["base"]}, "no foot 'base'; choose from: upper, lower, hand"),
        ({"root": "free"}, "root of this robot is fixed, or fixed, and not free"),
        ({"camera": "zx"}, "PLANE.*plane xz or yz or xy, got 'zx'"),
        ({"camera": "xz,-1"}, "PLANE"),
        ({"camera": "xz,1,2,3"}, "PLANE"),
        ({"name": "gym:x"}, "a name is"),
        ({"name": "null"}, "missing value"),
    ],
)
def test_a_choice_that_cannot_be(options, said, tmp_path):
    with pytest.raises(UserError, match=said):
        add_robot(MODELS / "arm.xml", tmp_path, **({"name": "arm"} | options))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()], "nothing is kept"


def test_models_that_cannot_be_used(tmp_path):
    def refused(file, said, **options):
        data_dir = tmp_path / "data"
        with pytest.raises(UserError, match=said) as caught:
            add_robot(file, data_dir, name="robot", **options)
        assert "\n" not in str(caught.value) and ".robot-" not in str(caught.value)
        assert not [path for path in data_dir.rglob("*") if path.is_file()], "nothing is kept"

    refused(MODELS / "wrong.xml", "cannot compile wrong.xml: .*unknown transmission target 'nowhere'.*line 9")
    refused(MODELS / "idle.xml", "idle.xml has no actuator")
    refused(MODELS / "nothing.xml", "there is no model")
    refused(written(tmp_path, "<mujoco><worldbody>"), "is no XML: no element found: line 1")
    still = '<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>'
    refused(written(tmp_path, still), "no body that can be seen and can move")
    mesh = legged(before='<asset><mesh name="m" file="{}"/></asset>')
    refused(
        written(tmp_path, mesh.format("shin.stl")), r"robot.xml names shin.stl \(line 1\), which is not in"
    )
    many = legged('<replicate count="3000" offset="1 0 0"><body><geom size="0.1"/></body></replicate>')
    refused(written(tmp_path, many), "more than 256 bodies")
    many = legged("".join(f'<body><geom size="0.1" pos="{k} 0 0"/></body>' for k in range(2500)))
    refused(written(tmp_path, many), "more than 256 bodies")
    nested = '<replicate count="1000">' * 5 + '<geom size="0.1"/>' + "</replicate>" * 5
    refused(written(tmp_path, legged(nested)), "elements")


def test_nothing_outside_the_folder_of_a_model_is_read(tmp_path):
    folder = tmp_path / "inner"
    folder.mkdir()
    shutil.copytree(MODELS / "crane/meshes", tmp_path / "meshes")
    shutil.copy(tmp_path / "meshes/block.obj", folder / "block.obj")
    (folder / "link.obj").symlink_to(tmp_path / "meshes/block.obj")
    (folder / "same.obj").symlink_to("block.obj")

    def add(before, **options):
        file = written(folder, legged('<geom type="mesh" mesh="m"/>', before))
        return add_robot(file, tmp_path / "data", name="robot", **options)

    mesh = '<asset><mesh name="m" file="{}"/></asset>'
    outside = [
        mesh.format("../meshes/block.obj"),
        mesh.format(tmp_path / "meshes/block.obj"),
        mesh.format("link.obj"),
        mesh.format("a/../../meshes/block.obj"),
        mesh.format("..\\\\meshes\\\\block.obj"),
        mesh.format("~/block.obj"),
        mesh.format("file:///etc/passwd"),
        '<compiler meshdir="../meshes"/>' + mesh.format("block.obj").replace("block", "wedge"),
        f'<compiler meshdir="{tmp_path}/meshes"/>' + mesh.format("block.obj"),
        '<include file="../other.xml"/>' + mesh.format("block.obj"),
        '<include file="/etc/hostname"/>' + mesh.format("block.obj"),
    ]
    written(tmp_path, "<mujoco/>", "other.xml")
    for before in outside:
        with pytest.raises(UserError, match=r"outside the model's folder|a place of one computer"):
            add(before)
    assert not [path for path in (tmp_path / "data").rglob("*") if path.is_file()]
    robot = add(mesh.format("same.obj"))
    copied = robot.xml.parent / "same.obj"
    assert copied.is_file() and not copied.is_symlink()
    remove_robot("robot", tmp_path / "data")
    robot = add(mesh.format("../meshes/block.obj"), folder=tmp_path)
    assert robot.xml.parts[-2:] == ("inner", "robot.xml")


def test_a_kept_robot_that_was_changed_is_not_used(used):
    robot = add_robot(MODELS / "arm.xml", used, name="arm")
    about = next(file for _, file in robots_in(used))
    was = about.read_text()
    about.write_text(json.dumps(json.loads(was) | {"model": "../../../escape.xml"}))
    with pytest.raises(UserError, match="robot arm is damaged"):
        load_robot(about)
    for broken in ("{", "[]", json.dumps(json.loads(was) | {"frame_skip": 0})):
        about.write_text(broken)
        with pytest.raises(UserError, match="robot arm is damaged"):
            load_robot(about)
    about.write_text(was)
    robot.xml.write_text(robot.xml.read_text().replace("0.35", "0.36"))
    registry.use(used)
    with pytest.raises(UserError, match="its model is not what was added"):
        registry.robot_named("arm")
    with pytest.raises(UserError, match=r"choose one of: .*humanoid.* or one of gymnasium"):
        registry.robot_named("leg")


def test_a_full_disk_keeps_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(library, "copy_model", full)
    with pytest.raises(UserError, match=r"cannot keep the robot in .*: No space left"):
        add_robot(MODELS / "arm.xml", tmp_path, name="arm")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("number", ["Walker2d-v5", "Reacher-v5", "InvertedPendulum-v5"])
def test_environments_of_gymnasium_are_robots_by_their_number(number):
    robot = registry.robot_named(f"gym:{number}")
    env = vector_env.RobotVectorEnv(robot, 2, nthread=0)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (2, robot.obs_size)
    if number == "Walker2d-v5":
        own = registry.robot_named("walker2d")
        assert (robot.dt, robot.limbs, robot.feet, robot.hidden) == (own.dt, own.limbs, own.feet, own.hidden)
    env.close()


@pytest.mark.parametrize(
    ("number", "said"),
    [
        ("CartPole-v1", "does not say which MuJoCo model"),
        ("Walker9d-v5", "gymnasium has no environment Walker9d-v5"),
        ("os:Walker2d-v5", "is called as gym:Walker2d-v5"),
        ("", "is called as gym:Walker2d-v5"),
    ],
)
def test_environments_that_are_no_robots(number, said):
    with pytest.raises(UserError, match=said):
        registry.robot_named(f"gym:{number}")


def test_an_environment_that_something_else_than_motors_moves():
    """As the Fetch robots, whose gripper is drawn to a place in the world."""

    class Drawn(MujocoEnv):
        metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

        def __init__(self, **_):
            space = gymnasium.spaces.Box(-1, 1, (3,))
            super().__init__(str(MODELS / "arm.xml"), 5, space, width=64, height=64)
            self.action_space = gymnasium.spaces.Box(-1, 1, (4,))

    gymnasium.register("Drawn-v0", entry_point=lambda **options: Drawn(**options))
    try:
        with pytest.raises(UserError, match=r"gym:Drawn-v0 takes actions \(4,\) where its model has 3 act"):
            registry.robot_named("gym:Drawn-v0")
    finally:
        del gymnasium.registry["Drawn-v0"]
