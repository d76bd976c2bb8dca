"""``onedemo bench robots``: the same method on other robots, each from one video and 350 ratings."""

from __future__ import annotations

from dataclasses import dataclass

from onedemo.experiments.jobs.method import method_job
from onedemo.experiments.report.blocks import Heading, Text
from onedemo.experiments.runner import Job
from onedemo.experiments.tables import parts
from onedemo.experiments.tables.parts import Goal, columns, figure, reach

RATINGS, FEW_RATINGS = 350, 55
STEPS = 1_500_000
QUICK_RATINGS, QUICK_STEPS = 30, 32_000


@dataclass(frozen=True, slots=True)
class Case:
    """One robot with one demo."""

    demo: str
    robot: str
    ratings: int

    @property
    def label(self) -> str:
        """What the table calls it."""
        return f"{self.robot}: {self.demo}, {self.ratings} ratings"


WALKER = Case("walker2d-hop", "walker2d", RATINGS)
CHEETAH = Case("half-cheetah-run", "half-cheetah", RATINGS)
HOP = Case("hopper-hop", "hopper", FEW_RATINGS)
FLIP = Case("hopper-backflip", "hopper", RATINGS)
CLEAN = Case("hopper-flip-clean", "hopper", RATINGS)
CASES = (WALKER, CHEETAH, HOP, FLIP, CLEAN)
SPEEDS = {WALKER: 1.78, CHEETAH: 4.29}
"""Mean velocity of the robot in the demo, m/s."""


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """Seed by seed."""
    cases = (WALKER, CHEETAH) if quick else CASES
    return [
        method_job(
            case.label, seed, demo=case.demo, ratings=QUICK_RATINGS if quick else case.ratings,
            steps=QUICK_STEPS if quick else STEPS, changes={"env": case.robot},
        )
        for seed in seeds for case in cases
    ]  # fmt: skip


def _goes(case: Case, share: float) -> Goal:
    speed = share * SPEEDS[case]
    return reach(case.label, f"{share:g} of the demo's speed, {speed:.2f} m/s", of_5=4, travel=speed)


GOALS = (
    _goes(WALKER, 0.6),
    _goes(CHEETAH, 0.6),
    reach(HOP.label, "0.76 of TRPO's reward, 2,660", of_5=4, hop_reward=2660),
    reach(FLIP.label, "no worse than before: 7.8 net turns", of_5=3, net_turns=7.8),
    reach(CLEAN.label, "no worse than before: 2.7 net turns", of_5=3, net_turns=2.7),
)
"""The project's, set before any of these runs. Means of 16 episodes."""

_TEXT = (
    "Each robot learns from one video of its own (made by TRPO on gymnasium's reward, and rendered) and from "
    "the ratings of a simulated rater that makes no error and compares what a person would see. **Travel**: "
    "mean velocity of the root to the right, m/s. **Upright**: seconds until gymnasium's rule calls it "
    "fallen; the half-cheetah has none, there it is until it leans by 60 degrees. **Stock reward**: "
    "gymnasium's, over the whole episode."
)
_FIGURES = {
    "travel, m/s": figure("travel"),
    "upright, s": figure("upright_seconds"),
    "stock reward": figure("stock_reward"),
    **columns("similarity, aligned", "net turns", "ratings", "minutes"),
}

TABLE = parts.Experiment(
    title="onedemo: other robots", seeds=5, plan=plan,
    parts=[
        Text(_TEXT),
        Heading("What should be reached"),
        parts.Goals(GOALS),
        Heading("What the agents do"),
        parts.Figures(_FIGURES, parts.OVER_SEEDS),
        parts.Figures(_FIGURES, "Each seed", parts.each),
    ],
)  # fmt: skip
