"""The pose from silhouettes: what is seen of masks, what is drawn to learn from, what a net makes of it."""

import logging
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.small_world import FRAME_STEPS, Thumbnail, falling_states, small_config
from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import find_demo
from onedemo.robots.registry import robot_named
from onedemo.sim import kinematics
from onedemo.storage.store import Store
from onedemo.training.runs import add_run
from onedemo.training.training_run import TrainingRun
from onedemo.vision import learned_robots, silhouette
from onedemo.vision.mask_file import masks_of
from onedemo.vision.masks import Masks
from onedemo.vision.pose_estimator import shipped_track
from onedemo.vision.silhouette import Silhouette, fit, learn
from onedemo.vision.silhouette_pictures import (
    FRAMES,
    TRAVEL_SCALE,
    Eye,
    Films,
    Silhouettes,
    aims,
    films,
    names_of,
    swaps_of,
)
from onedemo.vision.silhouette_views import PLACES, SIDE, Views, views

REACH = 1.6


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


# What is seen of masks


def bar(count=6, scale=50, step=0, height=120, width=160):
    """An upright bar, 1 m high and 0.2 m wide, that stands on row 100 and goes right by ``step`` columns."""
    masks = np.zeros((count, height, width), bool)
    for index, mask in enumerate(masks):
        left = 40 + step * index
        mask[100 - scale : 100, left : left + scale // 5] = True
    return masks


def seen(masks, scale=50.0, way=None, **more):
    more = {"floor": np.full(len(masks), 100.0), "reach": REACH, "fps": 30.0} | more
    return views(masks, scale=scale, way=way, **more)


def test_the_same_shape_looks_the_same_at_any_size_and_place():
    small = seen(bar())
    large = seen(np.kron(bar(), np.ones((3, 3), bool)), scale=150.0, floor=np.full(6, 300.0))
    moved = seen(np.roll(bar(), (7, -20), axis=(1, 2)), floor=np.full(6, 107.0))
    for other in (large, moved):
        assert np.abs(other.crops.astype(int) - small.crops).mean() < 4
        np.testing.assert_allclose(other.places, small.places, atol=0.02)
    rows, columns = np.nonzero(small.crops[0] > 127)
    assert abs(rows.mean() + 0.5 - SIDE / 2) < 1 and abs(columns.mean() + 0.5 - SIDE / 2) < 1


def test_places_are_metres_above_the_floor_and_metres_a_second():
    stands = seen(bar(), way=np.zeros(6)).places
    np.testing.assert_allclose(stands[:, :3], [[0.5, 1.0, 0.0]] * 6, atol=1e-6)  # middle, top, bottom
    goes = seen(bar(step=2), way=np.zeros(6)).places
    followed = seen(bar(), way=np.arange(6) * 2 / 50).places
    np.testing.assert_allclose(goes[:, 3], 0.2 * 2 / 50 * 30, atol=1e-6)
    np.testing.assert_allclose(followed, goes, atol=1e-6)


def test_what_is_not_known_is_said():
    masks = bar(step=2)
    masks[2] = False
    lost = seen(masks, way=np.zeros(6), floor=np.array([100, 100, 100, np.nan, 100, 100.0]))
    assert lost.places[:, 5].tolist() == [1, 1, 0, 1, 1, 1] and not lost.crops[2].any()
    assert lost.places[:, 7].tolist() == [1, 1, 1, 0, 1, 1]
    whole = seen(bar(step=2), way=np.zeros(6))
    np.testing.assert_allclose(lost.places[:, :5], whole.places[:, :5], atol=1e-6)  # bridged
    blind = seen(bar(), floor=np.full(6, np.nan)).places
    assert not blind[:, [0, 1, 2, 3, 6, 7]].any() and np.isfinite(blind).all()
    assert not seen(np.zeros_like(masks)).places.any()


# What is drawn


@pytest.fixture(scope="module")
def drawn():
    return films("hopper", 6, 7, lambda share: None)


@pytest.mark.seam
def test_films_are_of_the_robot_and_what_it_does(drawn):
    size = len(names_of(robot_named("hopper")))
    assert drawn.crops.shape == (6, FRAMES, SIDE, SIDE) and drawn.places.shape == (6, FRAMES, PLACES)
    assert drawn.aims.shape == (6, FRAMES, size) and 1.4 < drawn.reach < 1.8
    assert (drawn.crops > 127).mean() > 0.01 and np.isfinite(drawn.places).all()
    waves = drawn.aims[..., 1:9].reshape(*drawn.aims.shape[:2], 4, 2)
    np.testing.assert_allclose(np.linalg.norm(waves, axis=-1), 1, atol=1e-5)
    again = films("hopper", 6, 7, lambda share: None)
    np.testing.assert_array_equal(again.crops, drawn.crops)
    np.testing.assert_array_equal(again.places, drawn.places)


@pytest.mark.seam
def test_a_camera_shows_each_geom_where_it_is():
    hidden = falling_states()
    eye = Eye(azimuth=90, elevation=-15, distance=3.0, view=2.4)
    with Silhouettes(robot_named("hopper"), 200) as drawing:
        for q in hidden.qpos[::25]:
            at = drawing.middle(q)
            which = drawing.draw(q, eye, at)
            assert set(np.unique(which)) <= {-1, 1, 2, 3, 4} and 3 in which
            # The foot is the lowest or not: its pixels lie about its own place.
            foot = drawing.data.geom_xpos[4]
            rows, columns = np.nonzero(which == 4)
            if len(rows) > 30:  # it may be behind others
                row = eye.row_below(200, at[2] - foot[2])
                column = 100 + (foot[0] - at[0]) * 200 / 2.4
                assert abs(rows.mean() - row) < 14 and abs(columns.mean() - column) < 14


# What a net makes of it


@pytest.fixture(scope="module")
def simple():
    """Films of a bar that leans: one direction and its rate, and where it is."""
    rng, count = np.random.default_rng(0), 100
    crops = np.zeros((count, FRAMES, SIDE, SIDE), np.uint8)
    places = np.zeros((count, FRAMES, PLACES), np.float32)
    lean = rng.uniform(-1.5, 1.5, (count, 1)) + rng.normal(0, 2, (count, 1)) * np.arange(FRAMES) / 30
    rows, columns = np.mgrid[:SIDE, :SIDE] - SIDE / 2 + 0.5
    along = -np.cos(lean)[..., None, None] * rows + np.sin(lean)[..., None, None] * columns
    across = np.sin(lean)[..., None, None] * rows + np.cos(lean)[..., None, None] * columns
    crops[:] = 255 * ((np.abs(across) < 2) & (np.abs(along) < 18) | (np.hypot(across, along - 16) < 5))
    places[..., 0] = rng.uniform(0.2, 1.5, (count, 1))
    places[..., 3] = rng.normal(0, 0.3, (count, 1))
    places[..., 5:] = 1
    height = kinematics.HEIGHT_SCALE * places[..., :1]
    pose = np.concatenate([height, np.stack([np.sin(lean), np.cos(lean)], -1)], -1)
    motion = np.gradient(pose, axis=1)
    numbers = [pose, motion, 2 * places[..., 3:4], 0.5 * height]
    shown = np.concatenate(numbers, -1).astype(np.float32)
    return Films(crops=crops, places=places, aims=shown, reach=REACH, swaps=np.arange(8)[None])


@pytest.fixture(scope="module")
def learned(simple):
    return fit(simple, epochs=6)


@pytest.mark.slow
def test_a_fit_explains_films_held_out_and_says_how_well(learned, simple):
    assert learned.held_out[[0, 1, 6]].min() > 0.8 and learned.held_out[2] > 0.5
    held_out = slice(90, None)
    read = [
        learned.read(Views(crops=c, places=p))[0]
        for c, p in zip(simple.crops[held_out], simple.places[held_out], strict=True)
    ]
    some = [0, 1, 2, 6]  # the others do not vary
    aims = simple.aims[held_out][..., some]
    error = np.square(np.stack(read)[..., some] - aims).mean(axis=(0, 1))
    np.testing.assert_allclose(learned.held_out[some], 1 - error / aims.var(axis=(0, 1)), atol=1e-3)


@pytest.mark.slow
def test_doubt_is_about_the_error_and_grows_where_nothing_like_it_was_learned(learned, simple):
    rng = np.random.default_rng(1)
    views_of = [Views(crops=simple.crops[n], places=simple.places[n]) for n in range(90, 100)]
    known = np.concatenate([learned.read(view)[1] for view in views_of])
    noise = np.concatenate([
        learned.read(Views(crops=rng.permuted(view.crops, axis=2), places=view.places))[1]
        for view in views_of
    ])  # fmt: skip
    assert (known >= 0).all() and (noise <= 1).all()
    assert noise.mean() > 2 * known.mean() and known.mean() < 0.3


@pytest.mark.slow
def test_the_same_films_give_the_same_nets_on_any_number_of_threads(simple):
    few = replace(simple, crops=simple.crops[:30], places=simple.places[:30], aims=simple.aims[:30])
    one = fit(few, epochs=1)
    torch.set_num_threads(2)
    two = fit(few, epochs=1)
    assert torch.get_num_threads() == 2 and one.tensors.keys() == two.tensors.keys()
    for name, tensor in one.tensors.items():
        np.testing.assert_array_equal(tensor, two.tensors[name], err_msg=name)


def masks_in(crops, **more):
    count = len(crops)
    defaults = {
        "floor": np.full(count, 100.0), "scale": 50.0, "way": np.zeros(count), "doubt": np.zeros(count),
        "method": "still",
    }  # fmt: skip
    return Masks(masks=crops, **defaults | more)


def test_limbs_that_are_alike_are_found_in_the_model():
    assert len(swaps_of(robot_named("hopper"))) == len(swaps_of(robot_named("half-cheetah"))) == 1
    walker = robot_named("walker2d")
    names, (as_is, swapped) = names_of(walker), swaps_of(walker)
    assert as_is.tolist() == list(range(len(names)))
    moved = {names[a]: names[b] for a, b in enumerate(swapped) if a != b}
    assert (
        moved["right of thigh"] == "right of thigh_left"
        and moved["rate of up of foot_left"] == "rate of up of foot"
    )
    assert "height" not in moved and "up of torso" not in moved and len(moved) == 24
    assert len(swaps_of(robot_named("humanoid"))) == 4  # arms and legs


def test_limbs_that_are_alike_keep_their_places_through_a_video():
    """Two that cross, read with places changed in some frames."""
    time = np.linspace(0, 2, 40)
    angles, spins = np.stack([3 * time, 1 - time], axis=1), np.array([3.0, -1.0])
    waves = np.stack([np.sin(angles), np.cos(angles)], axis=-1).reshape(40, 4)
    rates = 0.15 * np.stack([np.cos(angles) * spins, -np.sin(angles) * spins], axis=-1).reshape(40, 4)
    none = np.zeros((40, 1))
    numbers = np.concatenate([none, waves, none, rates, none, none], axis=1)
    swaps = np.array([range(12), [0, 3, 4, 1, 2, 5, 8, 9, 6, 7, 10, 11]])
    rng = np.random.default_rng(0)
    mixed = np.where(rng.random((40, 1)) < 0.4, numbers[:, swaps[1]], numbers)
    steady = silhouette._steady(mixed, swaps)
    assert min(np.abs(steady - numbers[:, order]).max() for order in swaps) == 0
    assert np.abs(mixed - numbers).max() > 0.5


@pytest.mark.slow
def test_a_video_of_another_frame_rate_and_with_nothing_in_it(learned, simple):
    def found(masks, **more):
        return masks_in(masks, scale=SIDE / 1.15 / REACH, **more)

    masks, none = simple.crops[95] > 127, np.zeros((FRAMES, SIDE, SIDE), bool)
    plain, doubt = learned.numbers(found(masks), 30.0)
    fast, _ = learned.numbers(found(np.repeat(masks, 2, axis=0)), 60.0)
    assert plain.shape == (FRAMES, 8) and len(fast) == 2 * FRAMES and doubt.max() < 1
    np.testing.assert_allclose(fast[4:-4:2, :3], plain[2:-2, :3], atol=0.15)
    assert learned.track(found(none), 30.0) is None
    nothing, doubt = learned.numbers(found(none), 30.0)
    assert (doubt == 1).all() and np.isfinite(nothing).all()


@pytest.mark.seam
@pytest.mark.slow
def test_what_was_learned_is_kept_by_the_model(tmp_path, monkeypatch, caplog):
    first = learn("hopper", tmp_path, count=6, epochs=1, shipped=False)
    (file,) = tmp_path.iterdir()
    drawn = []
    monkeypatch.setattr(silhouette, "films", lambda *args: drawn.append(args))
    again = learn("hopper", tmp_path, shipped=False)
    assert not drawn and file.name.startswith(learned_robots.model_name("hopper"))
    for name, tensor in first.tensors.items():
        np.testing.assert_array_equal(again.tensors[name], tensor)
    file.write_bytes(file.read_bytes()[:-20])
    with caplog.at_level(logging.WARNING), pytest.raises(AttributeError):
        learn("hopper", tmp_path, shipped=False)  # nothing is drawn: there is nothing to fit
    assert drawn and "is damaged" in caplog.text


# What comes with the program


def test_a_built_in_demo_is_known_without_a_look_at_the_robot(tmp_path):
    def stop(*args):
        raise AssertionError("the robot is looked at")

    demo = find_demo("hopper-hop", tmp_path / "demos")
    config = small_config(method="onedemo", predictor__appearance=True)
    with closing(Store(tmp_path)) as store:
        add_run(store, tmp_path, demo, config, name="r")
        training = TrainingRun(
            store=store, data_dir=tmp_path, run="r", demo=demo, config=config, encoder=Thumbnail(),
            learn_robot=stop,
        )  # fmt: skip
        features, track = training.look()
    assert len(features) == demo.frames
    np.testing.assert_array_equal(track.pose, shipped_track(demo).pose)


def test_a_known_robot_is_read_at_once_from_a_small_file(tmp_path):
    """No picture is drawn and nothing is fitted at the first start with a new data directory."""
    file = learned_robots.SHIPPED / f"{silhouette.file_name('hopper')}.npz"
    assert file.stat().st_size < 1_000_000

    def stop(share):
        raise AssertionError("it is being learned")

    learned = learn("hopper", tmp_path, stop)
    assert not list(tmp_path.iterdir())
    by_name = dict(zip(names_of(robot_named("hopper")), learned.held_out, strict=True))
    assert min(by_name[f"{way} of {limb}"] for way in ("right", "up") for limb in ("torso", "foot")) > 0.85
    assert by_name["height"] > 0.8 and by_name["travel"] > 0.6


def read_frames_of(demo):
    hidden, robot = load_hidden(hidden_path(demo.path)), robot_named("hopper")
    at = np.minimum(steps_of_frames(demo.frames, robot.dt, demo.fps), len(hidden.qpos) - 1)
    return aims(robot, hidden.qpos[at], hidden.obs[at])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper-backflip", "hopper-flip-clean", "hopper-hop"])
def test_it_reads_the_built_in_demos_better_than_what_ships_beside_them(name, tmp_path):
    demo, learned = find_demo(name, tmp_path / "demos"), learn("hopper", tmp_path)
    found, right = masks_of(demo, learned.reach), read_frames_of(demo)
    track = learned.track(found, demo.fps)
    error = np.sqrt(np.square(track.pose - right[:, :9]).mean())
    assert error < 0.15 and error < np.sqrt(np.square(shipped_track(demo).pose - right[:, :9]).mean())
    assert np.sqrt(np.square(track.travel - right[:, -2] / TRAVEL_SCALE).mean()) < 1.3  # m/s
    assert np.median(track.doubt) < 0.35
    waves = track.pose[:, 1:].reshape(-1, 2)
    np.testing.assert_allclose(np.linalg.norm(waves, axis=1), 1, atol=1e-5)
    blind = replace(found, way=None, floor=np.full(demo.frames, np.nan))
    known = learned.track(blind, demo.fps)
    assert known.travel is None and known.contact is None
    assert np.sqrt(np.square(known.pose[:, 1:] - right[:, 1:9]).mean()) < 0.2


def shapes():
    rows, columns = np.mgrid[:120, :160]
    turn = np.arange(40)[:, None, None] / 6
    rng = np.random.default_rng(0)
    yield "disc", np.hypot(rows - 60, columns - 80 - 10 * np.sin(turn)) < 25
    yield "square", (np.abs(rows - 70) < 22) & (np.abs(columns - 80 - 10 * np.sin(turn)) < 22)
    yield "specks", rng.random((40, 120, 160)) < 0.02


@pytest.mark.parametrize("name, masks", list(shapes()), ids=[name for name, _ in shapes()])
def test_it_knows_another_body(name, masks, tmp_path):
    found = masks_in(masks)
    assert learn("hopper", tmp_path).track(found, 30.0) is None


@pytest.mark.seam
def test_it_reads_a_fall_from_drawn_masks(tmp_path):
    hidden, look = falling_states(), Eye(azimuth=90, elevation=-5, distance=3.5, view=3.0)
    qpos = hidden.qpos[FRAME_STEPS]
    with Silhouettes(robot_named("hopper"), 240) as drawing:
        at = np.stack([drawing.middle(q) for q in qpos])
        masks = np.stack([drawing.draw(q, look, p) >= 0 for q, p in zip(qpos, at, strict=True)])
    found = masks_in(masks, floor=look.row_below(240, at[:, 2]), scale=80.0, way=at[:, 0])
    learned: Silhouette = learn("hopper", tmp_path)
    track = learned.track(found, 30.0)
    right = aims(robot_named("hopper"), qpos, hidden.obs[FRAME_STEPS])[:, :9]
    assert np.abs(track.pose - right).mean() < 0.15
    assert track.doubt.mean() < 0.4
