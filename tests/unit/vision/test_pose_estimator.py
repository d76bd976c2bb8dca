"""Learning what the robot looks like, on real pictures where they matter."""

import functools
import logging

import numpy as np
import pytest
import torch

from helpers.small_world import FRAME_STEPS, Thumbnail, falling_states
from onedemo.demos.library import list_demos, stream_frames
from onedemo.render.renderer import HEIGHT, WIDTH, Renderer
from onedemo.robots.registry import robot_named
from onedemo.sim import kinematics
from onedemo.sim.kinematics import body_of
from onedemo.vision import pose_estimator
from onedemo.vision.encoders import make_encoder
from onedemo.vision.pose_estimator import PoseEstimator, learn, pictures, regress

BODY = body_of(robot_named("hopper"))


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


# The regression and the track, without pictures


def seen(poses, seed=0):
    """What a plain encoder would make of poses: a random mixture of them, and of their squares."""
    mixture = np.random.default_rng(seed).normal(size=(2 * BODY.pose_size, 40)).astype(np.float32)
    return np.concatenate([poses, np.square(poses)], axis=1) @ mixture


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(1)
    obs = np.zeros((600, 11))
    obs[:, 0], obs[:, 1:5] = rng.uniform(0.2, 1.5, 600), rng.uniform(-np.pi, np.pi, (600, 4))
    return BODY.pose(obs).astype(np.float32)


quick_regress = functools.partial(regress, epochs=10)


@pytest.mark.slow
def test_the_regression_finds_the_pose_and_says_how_well(poses):
    learned = quick_regress(seen(poses), poses)
    held_out = seen(poses[540:]), poses[540:]
    error = np.square(learned.poses(held_out[0]) - held_out[1]).mean(axis=0)
    np.testing.assert_allclose(learned.held_out, 1 - error / held_out[1].var(axis=0), atol=1e-4)
    assert learned.held_out.shape == (BODY.pose_size,) and learned.held_out.mean() > 0.85
    # Of features that have nothing to do with the pose it says so.
    assert quick_regress(np.random.default_rng(2).permutation(seen(poses)), poses).held_out.max() < 0.2


@pytest.mark.slow
def test_the_same_pictures_give_the_same_networks_on_any_number_of_threads(poses):
    one = quick_regress(seen(poses), poses)
    torch.set_num_threads(2)
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    two = quick_regress(seen(poses), poses)
    assert torch.get_num_threads() == 2 and torch.equal(torch.rand(2), expected)  # neither is touched
    torch.set_num_threads(1)
    assert one.tensors.keys() == two.tensors.keys()
    for name, tensor in one.tensors.items():
        np.testing.assert_array_equal(tensor, two.tensors[name], err_msg=name)


def test_it_is_made_again_from_its_tensors(poses):
    one = quick_regress(seen(poses), poses)
    two = PoseEstimator(one.tensors)
    np.testing.assert_array_equal(one.poses(seen(poses)), two.poses(seen(poses)))
    np.testing.assert_array_equal(one.held_out, two.held_out)


def test_strangeness_is_about_one_for_what_it_learned_from(poses):
    learned = quick_regress(seen(poses), poses)
    assert learned.strangeness(seen(poses)) == pytest.approx(1, abs=0.01) and learned.knows(seen(poses))
    assert learned.strangeness(10 * seen(poses)) > 50 and not learned.knows(10 * seen(poses))


class PerfectEye(PoseEstimator):
    """Its features are the pose."""

    def __init__(self):
        pass

    def poses(self, features):
        return features


def test_the_track_of_a_steady_move_is_right_from_the_first_frame_to_the_last():
    """It climbs at 2 m/s, the parts turn, some backwards and more than once round."""
    fps, count = 30.0, 40
    times = np.arange(count)[:, None] / fps
    climb, spins = 2.0, np.array([-9.0, 3.0, 0.5, 6.0])
    height, angles = 0.3 + climb * times[:, 0], 1.0 + times * spins
    frames = BODY.pose_of(height, angles)
    track = PerfectEye().track(frames, fps)
    assert track.pose.dtype == track.motion.dtype == np.float32
    np.testing.assert_allclose(track.pose, frames, atol=1e-5)
    expected = BODY.motion_of(np.full(count, climb), angles, np.tile(spins, (count, 1)))
    np.testing.assert_allclose(track.motion, expected, atol=1e-5)
    # Twice as many frames a second: the same move.
    slow, fast = (PerfectEye().track(frames, rate).motion for rate in (fps, 2 * fps))
    assert fast[5, 0] == pytest.approx(2 * slow[5, 0])


def test_the_track_of_a_fall_is_near_its_true_motion():
    hidden = falling_states()
    obs = hidden.obs[FRAME_STEPS]
    track = PerfectEye().track(BODY.pose(obs), 30.0)
    np.testing.assert_allclose(track.pose, BODY.pose(obs), atol=0.2)
    true = BODY.motion(obs)  # a tenth of a second is seen at once, in which it jerks and hits the ground
    assert np.corrcoef(track.motion.ravel(), true.ravel())[0, 1] > 0.85
    assert np.abs(track.motion - true)[:2].mean() < 0.1 < np.abs(true).mean()


def test_sines_that_fall_short_of_one_are_directions_all_the_same():
    frames = BODY.pose_of(np.full(9, 1.0), np.linspace(0, 1, 36).reshape(9, 4))
    short = frames * np.r_[1.0, np.full(8, 0.6)]
    np.testing.assert_allclose(PerfectEye().track(short, 30.0).pose, PerfectEye().track(frames, 30.0).pose)


# Pictures


@pytest.fixture(scope="module")
def efficientnet():
    return make_encoder("efficientnet-lite0")


@pytest.fixture(scope="module")
def learned(efficientnet, looked):
    """From 300 pictures of the real renderer; a run takes 4,000."""
    return learn("hopper", efficientnet, looked / "robots")


@pytest.mark.seam
def test_a_few_real_pictures_explain_most_of_the_pose(learned):
    assert learned.held_out.mean() > 0.5
    assert learned.held_out[0] > 0.5  # the height
    assert learned.held_out[1:3].mean() > 0.5  # the torso's direction


@pytest.mark.seam
def test_it_knows_its_robot_and_no_other_picture(learned, efficientnet):
    with Renderer() as renderer:
        robot = efficientnet.encode(renderer.render(falling_states().qpos[FRAME_STEPS[::10]]))
    assert learned.knows(robot)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (4, HEIGHT, WIDTH, 3), dtype=np.uint8)
    ramp = np.linspace(0, 255, WIDTH).astype(np.uint8)
    gradient = np.stack(
        [np.broadcast_to(np.roll(ramp, 60 * i)[None, :, None], (HEIGHT, WIDTH, 3)) for i in range(4)]
    )
    phase = np.hypot(*np.meshgrid(np.arange(WIDTH) / 40, np.arange(HEIGHT) / 40))[..., None]
    plasma = np.stack([(127 + 127 * np.sin(phase + i + np.arange(3))).astype(np.uint8) for i in range(4)])
    for name, video in {"noise": noise, "gradient": gradient, "plasma": plasma}.items():
        assert not learned.knows(efficientnet.encode(video)), name


@pytest.mark.seam
def test_it_knows_the_built_in_demos(learned, efficientnet, tmp_path):
    demos = list_demos(tmp_path)
    assert len(demos) >= 3
    for demo in demos:
        frames = [frame for i, frame in enumerate(stream_frames(demo)) if i % 40 == 0]
        assert learned.knows(efficientnet.encode(frames)), demo.name


@pytest.mark.seam
def test_pictures_come_with_the_poses_they_show():
    """As a picture is drawn of the pose beside it, one that is drawn of that pose again looks the same."""
    features, poses = pictures("hopper", Thumbnail(), 48)
    assert features.shape == (48, Thumbnail.dims) and poses.shape == (48, BODY.pose_size)
    angles = np.arctan2(poses[:, 1::2], poses[:, 2::2])
    joints = angles[:, :-1] - angles[:, 1:]
    joints[:, :2] = (joints[:, :2] + np.pi) % (2 * np.pi) - np.pi
    qpos = np.zeros((48, 6))
    qpos[:, 1], qpos[:, 2], qpos[:, 3:] = poses[:, 0] / kinematics.HEIGHT_SCALE, angles[:, 0], joints
    with Renderer() as renderer:
        again = Thumbnail().encode(renderer.render(qpos))
    difference = np.abs(again[:, None] - features[None]).mean(axis=-1)
    assert (difference.argmin(axis=1) == np.arange(48)).mean() > 0.9
    standing = np.abs(poses - BODY.pose_of(np.array(1.25), np.zeros(4))).max(axis=1) < 0.05
    assert 0 < standing.sum() < 24  # some as they begin upright, most not


class OtherEncoder(Thumbnail):
    name = "other"


quick_learn = functools.partial(learn, count=60, epochs=10)


@pytest.mark.seam
def test_what_was_learned_is_kept_and_made_anew_when_damaged(tmp_path, monkeypatch, caplog):
    first = quick_learn("hopper", Thumbnail(), tmp_path)
    (file,) = tmp_path.iterdir()

    def nothing_is_drawn(*args):
        raise AssertionError("it was drawn again")

    with monkeypatch.context() as patch:
        patch.setattr(pose_estimator, "pictures", nothing_is_drawn)
        again = quick_learn("hopper", Thumbnail(), tmp_path)
        with pytest.raises(AssertionError, match="drawn again"):
            quick_learn("hopper", Thumbnail(), tmp_path / "elsewhere")
        with pytest.raises(AssertionError, match="drawn again"):
            quick_learn("hopper", OtherEncoder(), tmp_path)
    features = np.random.default_rng(0).uniform(0, 255, (5, 64)).astype(np.float32)
    np.testing.assert_array_equal(again.poses(features), first.poses(features))
    np.testing.assert_array_equal(again.held_out, first.held_out)
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 255
    for damaged in (whole[: len(whole) // 2], b"", bytes(flipped)):
        file.write_bytes(damaged)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            anew = quick_learn("hopper", Thumbnail(), tmp_path)
        assert "is damaged" in caplog.text
        np.testing.assert_array_equal(anew.poses(features), first.poses(features))
        assert file.read_bytes() == whole
    kept = {p.name for p in tmp_path.iterdir() if p.name != "elsewhere"}
    assert kept == {file.name, f"{file.name}.damaged"}
