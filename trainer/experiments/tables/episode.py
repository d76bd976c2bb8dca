"""What was learned, as a picture in a report: an episode beside its demo."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onedemo.demos.library import find_demo
from onedemo.errors import UserError
from onedemo.experiments.jobs.person import person_demo
from onedemo.experiments.report.blocks import Block, Picture, Text, number
from onedemo.experiments.report.movie import movie
from onedemo.experiments.report.strip import strip
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.tables.parts import Groups, Pick, figure
from onedemo.types import Demo

BESIDE = "{demo} on the left, {label} on the right: seed {seed}, {value} net turns"


def median_outcome(outcomes: Sequence[Outcome], pick: Pick) -> Outcome | None:
    """The one whose figure is the median of those that have one, the lower of two; None if none has."""
    done = [(value, o.job.seed, o) for o in outcomes if o.result and (value := pick(o.result)) is not None]
    return sorted(done, key=lambda entry: entry[:2])[(len(done) - 1) // 2][2] if done else None


@dataclass(frozen=True, slots=True)
class Episode:
    """The best episode of the median seed beside the demo: moving, or as a strip; nothing without results."""

    label: str
    name: str
    """Of the file."""
    text: str
    """``{demo}``, ``{label}``, ``{seed}`` and ``{value}`` stand for what was taken."""
    note: str = "{text}; the median seed, its best episode."
    figure: str = "net_turns"
    """Whose median is taken, and which is the ``value`` of the episode."""
    part: tuple[float, float] | None = None
    """First and last moment of a strip, as shares of the demo; a moving picture if None."""

    def __call__(self, groups: Groups) -> Iterable[Block]:
        """The picture, or why there is none."""
        median = median_outcome(groups.get(self.label, ()), figure(self.figure))
        if median is None or median.result is None:
            return
        shown = median.result["episode"]
        qpos = np.array(shown["qpos"])
        try:
            with tempfile.TemporaryDirectory() as scratch:
                demo = _demo_of(median.job, Path(scratch))
                if self.part is None:
                    data = movie(demo, qpos)
                else:
                    data = strip(demo, qpos, first=self.part[0], last=self.part[1])
        except UserError as error:
            yield Text(f"No picture of {self.label}: {error}.")
            return
        value = number(median.result["figures"][self.figure]["each"][shown["which"]])
        facts = {"demo": demo.name, "label": self.label, "seed": median.job.seed, "value": value}
        text = self.text.format(**facts)
        yield Picture(name=self.name, data=data, alt=text, note=self.note.format(text=text, **facts))


def _demo_of(job: Job, scratch: Path) -> Demo:
    return person_demo(scratch) if job.kind == "person" else find_demo(job.settings["demo"], scratch)
