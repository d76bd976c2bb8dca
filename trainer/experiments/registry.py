"""The tables of the paper and ours, by name. Light: the command line reads it."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from onedemo.experiments.tables.parts import Experiment

TUNING_FROM = 100
"""Settings are tuned on seeds from here on, which no table reports; reports take 0, 1, 2 and so on."""

_MOST_SEEDS = 1000


@dataclass(frozen=True, slots=True)
class Entry:
    """A table that can be asked for."""

    module: str
    """Its ``TABLE`` is the ``Experiment``."""
    summary: str


TABLES = {
    "predictor": Entry("onedemo.experiments.tables.predictor", "how well ratings are predicted (Table 1)"),
    "backflip": Entry("onedemo.experiments.tables.backflip", "what is learned, by which method (Table 2)"),
    "transfer": Entry(
        "onedemo.experiments.tables.transfer", "what a predictor of another move is worth (Table 3)"
    ),
    "ratings": Entry("onedemo.experiments.tables.ratings", "how much is learned from how many ratings"),
    "person": Entry("onedemo.experiments.tables.person", "learning from a video of a real person"),
    "pose": Entry(
        "onedemo.experiments.tables.pose", "how well the pose is read from others' videos of a robot"
    ),
    "robots": Entry("onedemo.experiments.tables.robots", "the same method on other robots"),
    "ablation": Entry("onedemo.experiments.tables.ablation", "what each part of the method contributes"),
}
"""``onedemo bench NAME``; a new table is one module and one line here."""


def find_table(name: str) -> Experiment:
    """What a table is made of."""
    return importlib.import_module(TABLES[name].module).TABLE


def default_seeds(table: Experiment, *, quick: bool) -> tuple[int, ...]:
    """The seeds a table takes when none are given."""
    return tuple(range(min(2, table.seeds) if quick else table.seeds))


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds as typed: "5" is 0 to 4, "3,7,9" those, "7," seed 7 alone.

    Raises:
        ValueError: If it is neither a number of at least 1 nor a list of different numbers.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    numbers = [int(word) if word.isdecimal() else -1 for word in words]
    if "," not in text:
        numbers = list(range(min(numbers[0], _MOST_SEEDS + 1))) if numbers else []
    if len(numbers) > _MOST_SEEDS or not numbers or min(numbers) < 0 or len(set(numbers)) < len(numbers):
        raise ValueError(f"must be how many seeds, or a list of different ones such as 3,7,9; got {text!r}")
    return tuple(numbers)
