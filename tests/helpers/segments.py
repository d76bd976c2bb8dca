"""Segments for tests that look at no motion."""

import numpy as np

from onedemo.types import Segment


def noise(rng: np.random.Generator, steps: int) -> Segment:
    """A segment of random numbers, of the hopper's widths and the types that are stored."""
    widths = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}
    arrays = {name: rng.normal(size=(steps, width)) for name, width in widths.items()}
    return Segment(**arrays | {"actions": arrays["actions"].astype(np.float32)})
