"""The benchmark of pictures in its smallest form: real work on both sides, loose bounds."""

import shutil

import numpy as np
import pytest

from onedemo.experiments.speed import pictures
from onedemo.experiments.speed.figures import Figure


def test_poses_show_robots_flying_and_fallen():
    qpos, qvel = pictures.poses(40)
    assert qpos.shape == qvel.shape == (40, 6)
    assert qpos[:, 1].max() > 1.5 and qpos[:, 1].min() < 0.7  # height of the torso, metres


@pytest.mark.seam
def test_drawing_is_several_times_faster_than_gymnasium():
    figure = pictures._render(turns=1)
    assert isinstance(figure, Figure)
    assert figure.name == "render_vs_gymnasium" and figure.reach == 8
    assert figure.value > 3


@pytest.mark.slow
def test_features_are_equal_and_not_many_times_slower():
    figures = {figure.name: figure for figure in pictures._features(turns=1)}
    assert set(figures) == {"features_vs_single", "features_vs_single_one_core"}
    # Beside other tests one turn says little: `onedemo bench speed` measures on a quiet machine.
    assert figures["features_vs_single_one_core"].value > 0.3


@pytest.mark.seam
def test_kept_features_and_longer_demos(tmp_path, looked):
    shutil.copytree(looked / "demos", tmp_path, dirs_exist_ok=True)
    cached = pictures._cached(tmp_path, turns=1)
    assert cached.unit == "ms" and cached.value < 500
    growth = pictures._demo_length(tmp_path, (1, 2))
    assert list(growth.x) == [1, 2]
    lines = {name: np.array(cost) for name, cost in growth.y.items()}
    assert all((cost > 0).all() for cost in lines.values())
    assert (lines["features from the cache"] < lines["features"]).all()
