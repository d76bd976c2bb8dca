"""The examples of ratings are what they say: the oracle, which may see the states, agrees with each."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from onedemo.annotators.oracle import Oracle
from onedemo.app.annotation.examples import choose
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import BUILT_IN, find_demo
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.types import Segment
from onedemo.vision.pose_estimator import Track, shipped_track

BODY = body_of(robot_named("hopper"))

DT, LENGTH = 0.008, 9
DEMOS = ("hopper-backflip", "hopper-hop", "hopper-flip-clean")


@cache
def seen(name):
    demo = find_demo(name, BUILT_IN / "none")
    track = shipped_track(demo)
    assert track is not None and len(track.pose) == demo.frames
    return demo, track


@cache
def chosen_for(name):
    demo, track = seen(name)
    return choose(track, demo.frames, LENGTH, {other: seen(other)[1] for other in DEMOS if other != name})


def oracle_rating(demo, example):
    """What the oracle says of the states behind both sides, seen from the left one."""
    hidden = load_hidden(hidden_path(demo.path))
    other = load_hidden(hidden_path(seen(example.source)[0].path)) if example.source else hidden
    left, right = (round(frame / demo.fps / DT) for frame in (example.left, example.right))
    cut = slice(right, right + round(LENGTH / demo.fps / DT))
    segment = Segment(
        obs=other.obs[cut], actions=other.actions[cut], qpos=other.qpos[cut], qvel=other.qvel[cut]
    )
    return Oracle(hidden, budget=1).rate(segment, left)


@pytest.mark.parametrize("name", DEMOS)
def test_every_example_is_rated_so_by_whoever_sees_the_states(name):
    chosen, ratings = chosen_for(name), []
    for example in (*chosen.guide, *chosen.practice):
        said = oracle_rating(seen(name)[0], example)
        assert said in example.right_ratings, (example, said)
        ratings.append((said, example.rating))
    assert sum(said == rating for said, rating in ratings) >= 8  # of ten: the others are the next rating
    assert [e.rating for e in chosen.guide] == [1, 2, 3, 4, 5]
    assert [e.rating for e in chosen.practice] == [5, 1, 3, 4, 2]


@pytest.mark.parametrize("name", DEMOS)
def test_examples_are_apart(name):
    demo, chosen = seen(name)[0], chosen_for(name)
    everything = (*chosen.guide, *chosen.practice)
    for example in everything:
        last = (seen(example.source)[0] if example.source else demo).frames - LENGTH
        assert 0 <= example.left <= demo.frames - LENGTH and 0 <= example.right <= last
        # One frame late is not "a little off": either the same moment, or another one.
        assert example.source or example.left == example.right or abs(example.left - example.right) >= 8
        same = not example.source and example.left == example.right
        assert same == (example.rating == 5)
    for one, other in itertools.combinations(everything, 2):
        assert one.source != other.source or (
            max(abs(one.left - other.left), abs(one.right - other.right)) >= 4
        )
    assert len({example.name for example in everything}) == len(everything) == 10
    assert all(re.fullmatch("[a-z]{1,20}", example.name) for example in everything)


def test_where_the_body_is_unknown_only_the_same_moment_twice_is_shown():
    chosen = choose(None, 240, LENGTH)
    assert [(e.rating, e.left == e.right) for e in (*chosen.guide, *chosen.practice)] == [(5, True)] * 2
    assert abs(chosen.guide[0].left - chosen.practice[0].left) >= 4


def test_a_robot_that_hardly_moves_has_no_far_examples():
    angles = 0.05 * np.sin(np.arange(120)[:, None] / 9 + np.arange(4))
    pose = BODY.pose_of(np.full(120, 1.2), angles).astype(np.float32)
    chosen = choose(Track(pose=pose, motion=np.zeros_like(pose)), 120, LENGTH)
    assert {e.rating for e in (*chosen.guide, *chosen.practice)} == {5}


@pytest.mark.parametrize("frames", [9, 10, 20])
def test_a_short_demo_has_what_it_has(frames):
    pose = BODY.pose_of(np.linspace(1, 2, frames), np.linspace(0, 3, 4 * frames).reshape(-1, 4))
    track = Track(pose=pose.astype(np.float32), motion=np.zeros_like(pose, np.float32))
    for known in (track, None):
        chosen = choose(known, frames, LENGTH)
        assert chosen.guide and all(e.right + LENGTH <= frames for e in chosen.guide)


def test_what_is_said_of_an_example_is_what_differs():
    same = np.zeros(240)
    height = np.where(np.arange(240) < 120, 1.0, 1.9)
    pose = BODY.pose_of(height, np.stack([same] * 4, -1)).astype(np.float32)
    chosen = choose(Track(pose=pose, motion=np.zeros_like(pose)), 240, LENGTH)
    (example,) = [e for e in chosen.guide if e.rating == 3]
    assert example.why == "The pose differs clearly; direction and pace fit."


def test_moments_that_the_estimator_is_unsure_of_are_left_alone():
    demo, track = seen("hopper-backflip")
    doubt = np.where(np.arange(240) < 120, 0.0, 1.0).astype(np.float32)
    chosen = choose(replace(track, doubt=doubt), demo.frames, LENGTH)
    apart = [e for e in (*chosen.guide, *chosen.practice) if e.rating != 5]
    assert apart and all(max(e.left, e.right) < 120 for e in apart)
