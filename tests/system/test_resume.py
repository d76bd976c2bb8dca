"""A killed training goes on as if it had not been: the same to the bit as one that was left alone."""

import json
import os
import subprocess
import sys
from dataclasses import asdict

import pytest

from helpers.killed_training import MOMENTS, outcome
from helpers.paths import TESTS
from helpers.small_world import falling_demo

pytestmark = pytest.mark.seam


FEW = ("in a fit", "with half a checkpoint", "between two iterations", "after an answer")
"""Each moment costs a training; `make chaos` takes them all."""

DYING = str(TESTS / "helpers" / "killed_training.py")
RATER = "oracle+mistake:0.2+marks"


@pytest.mark.parametrize(
    ("method", "moments"),
    [
        ("paper", tuple(MOMENTS) if os.environ.get("ONEDEMO_LONG") else FEW),
        ("onedemo", ("with half a checkpoint",)),  # its fits take longer
    ],
)
def test_a_killed_training_ends_as_one_that_was_left_alone(tmp_path, method, moments):
    demo = asdict(falling_demo(tmp_path / "demo"))  # once: no two videos have the same hash
    (tmp_path / "demo.json").write_text(json.dumps(demo, default=str))

    command = [sys.executable, DYING, str(tmp_path), method, RATER, *moments]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(TESTS)}, stderr=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, done.stderr
    found, expected = outcome(tmp_path / "broken"), outcome(tmp_path / "whole")
    for what in expected:
        assert found[what] == expected[what], what
    assert len(expected["curve"]) == 4 and len(expected["ratings"]) >= 16
