"""Table 1 of the paper: how well ratings are predicted, by which kind of predictor, from which ratings.

And what the paper does not show: what such a predictor is worth as a reward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS
from onedemo.experiments.predictor_scores import BINS
from onedemo.experiments.report.blocks import Block, Bullets, Chart, Heading, Line, Reference, Table, Text
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.statistics import spread
from onedemo.experiments.tables import parts
from onedemo.experiments.tables import predictor_figures as figures
from onedemo.experiments.tables.parts import BarChart, Figures, Groups, Part, Section
from onedemo.experiments.tables.predictor_figures import COUNTED, OURS, PAPERS_CHOICE, POLICIES, named
from onedemo.reward.model import CLASSES

_SKEWED, _ASKED = "random policy", "asked by onedemo"
_DATA = {_SKEWED: "paper", _ASKED: "onedemo"}
_PARTS = ("fitted", "validation", "test")
_COMPARED = {
    "Accuracy": figures.ACCURACY,
    "Worth": named("own less shuffled", "picked states", OTHERS, ATTEMPTS),
}
_ENOUGH = 10
"""Clips in a bin of the reliability chart."""


def plan(seeds: tuple[int, ...], *, quick: bool) -> list[Job]:
    """One job for each kind of ratings and seed: all predictors are fitted on the same ratings."""
    sizes = {"rounds": 4, "clips": 100} if quick else {"rounds": 20, "clips": 300}
    config = {"rollouts.threads": 1} | ({"predictor.updates": 150} if quick else {})
    settings = {"demo": "hopper-backflip", "split": [200, 100, 100], "config": config, **sizes}
    return [
        Job(kind="predictor", label=label, settings=settings | {"data": data}, seed=seed)
        for seed in seeds
        for label, data in _DATA.items()
    ]


_INTRODUCTION = (
    "400 ratings by the oracle, which never errs, of clips beside one demo: 200 are fitted, 100 "
    "validate, 100 test. Nothing is chosen by the validation part, so both are unseen. Each seed has "
    "ratings, a split and first weights of its own, and all predictors of a seed share them. Figures are "
    "means ± standard deviations over seeds; dots are seeds."
)
_ABOUT = {
    _SKEWED: "As in the paper: an untrained policy from standing, each clip beside the same moment of the "
    "demo, chosen uniformly.",
    _ASKED: "What onedemo would ask for: random actions from random states, beside any moment of the demo, "
    "chosen in rounds by predicted rating, disagreement and chance, with a refit after each. The split is "
    "random, so the same kind of clips is fitted and tested; but they were chosen by the metric.",
}
_WORTH_TEXT = (
    "What the ratings are for is a reward, so each predictor is asked about what practice will show it. "
    "**Own states**: the predicted rating of the demo's own hidden states beside its own frames, where 5 "
    "is right; **shuffled**: beside frames of other moments. **Picked states**: of thousands of random "
    "states, those that it rates best at moments all over the demo, where practice would start; their "
    "*true* rating. Then the rank correlation (Spearman) of predicted rating and true nearness, over "
    "clips of four policies: a random one from standing and random actions from random states, both "
    "beside any moment of the demo; **other moves**, the clean flip and the hop disturbed by noise, "
    "beside any moment; and **attempts** at the move itself, its own states led astray by noise of any "
    "strength, within a clip's length of their moment. None of these clips has been rated. Hidden states "
    "are read for this judgement and by the oracle, nowhere else."
)
_DIFFERENCES_TEXT = (
    f"Each predictor less the paper's choice, the {PAPERS_CHOICE}, on the same ratings: mean over seeds "
    "and 95 % interval (Student's t). **Bold** where zero lies outside; of intervals of nothing one in "
    "twenty is bold, too. The first four rows are the paper's own comparison."
)
_CONFUSION_TEXT = "Clips not fitted, all seeds together: a row for each rating given."
_RELIABILITY_TEXT = (
    "Of the clips not fitted that were given a chance of, say, 60 to 70 % to be rated 3 or more: how "
    f"many were. All seeds together, bins of at least {_ENOUGH} clips."
)
_DEFINITIONS = (
    "**Predicted rating** of a clip: the most probable one; probabilities are means over its steps and "
    "over the predictor's members.",
    "**Validation** and **test**: accuracy on 100 ratings each, %. All other figures in the tables of "
    "accuracy are of these 200 together, since high ratings are few.",
    "**F1 of 3-5**: of the question whether a clip is rated 3 or more, `2 TP / (2 TP + FP + FN)`, %; of "
    "4-5 likewise. The paper does not say what its F1 is; **mean F1** is the other reading, a mean of "
    "the F1 of each class, without classes that are neither given nor predicted.",
    "**Off by 3, 4**: share of clips with an absolute error of 3 or 4, %.",
    f"**Calibration error**: expected |chance - share| of being rated 3 or more, over {BINS} equally wide "
    "bins of the chance, points (Naeini et al. 2015).",
    "**Always the same**: what it scores to predict the most frequent rating of those fitted for all clips.",
    "**Principal components**: the paper's choice, but its network sees 24 principal components of a "
    "frame's features and not all of them. **Ordinal loss**: the paper's choice, with ratings next to the "
    "one given counting as half right; **3 networks** of it, averaged. **Metric**: "
    "onedemo's, a learned distance between the robot's pose and the pose in the frame, as a model of the "
    "robot's looks sees it that was learned from its own pictures.",
)


def _variants(label: str) -> Callable[[Groups], Groups]:
    """A group for each predictor of one kind of ratings; none if there are no results."""

    def of(groups: Groups) -> Groups:
        group = groups.get(label, ())
        return figures.by_variant(group) if any(o.result for o in group) else {}

    return of


def _findings(groups: Groups) -> Iterable[Block]:
    there = {label: _variants(label)(groups) for label in _DATA}
    yield Bullets([s for label, found in there.items() if found for s in figures.findings(label, found)])


def _table(title: str, which: Mapping[str, parts.Pick], show: parts.Show = parts.mean, **more: Any) -> Part:
    return Figures(which, title, show, head="predictor", **more)


def _each(which: Mapping[str, parts.Pick]) -> Part:
    return _table("Each seed, in the order {seeds}", which, parts.each)


def _bars(
    label: str, head: str, title: str, x_label: str, reference: Callable[[Groups], Reference] | None = None
) -> Part:
    return BarChart(
        pick=figures.FIGURES[head], name=f"{head} {label}".lower().replace(" ", "-"), title=title,
        x_label=x_label, strong=[PAPERS_CHOICE, OURS], reference=reference,
        note="Dots: seeds. Strong bars: the paper's choice and onedemo's.",
    )  # fmt: skip


_COUNTS = {str(k + 1): lambda result, k=k: result["classes"][k] for k in range(CLASSES)}
_IN_THE_PAPER = Table(
    title="In the paper, %: ratings by people, means of 2 runs",
    heads=("predictor", *list(COUNTED)[:4]),
    rows=[[name, *each] for name, each in figures.PAPER.items()],
    notes=["With the additional layer 4.56 % of its clips were off by 3, 3.56 % by 4."],
)


def _classes(groups: Groups) -> Groups:
    return figures.split(groups[OURS], "classes", _PARTS)


def _always(groups: Groups) -> list[Any]:
    scores = [str(figures.always_the_same(groups[OURS], part)) for part in _PARTS[1:]]
    return ["always the same", *scores, *[None] * (len(COUNTED) - len(scores))]


def _level(groups: Groups) -> Reference:
    return Reference(label="always the same", y=figures.always_the_same(groups[OURS], "test").mean)


def _accuracy(label: str) -> list[Part]:
    return [
        Text(_ABOUT[label]),
        Section("", [Figures(_COUNTS, "Ratings of each class")], _classes),
        _table("Clips not fitted, %", COUNTED, last=_always),
        *([_IN_THE_PAPER] if label == _SKEWED else []),
        _bars(label, "test", f"Test accuracy; ratings: {label}", "%", _level),
        _bars(label, "F1 of 3-5", f"F1 of ratings 3 to 5; ratings: {label}", "%, clips not fitted"),
        _table("The other reading of F1, %; chances; cost", figures.BESIDES),
        _each(figures.ACCURACY),
    ]


def _truth(groups: Groups) -> list[Any]:
    return ["the truth", "5", str(spread(groups[OURS], lambda result: result["truth"]["shuffled"])), None]


def _true_ratings(groups: Groups) -> list[str]:
    of = {p: spread(groups[OURS], lambda result, p=p: result["truth"]["clips"][p]) for p in POLICIES}
    return [f"Mean true rating of these clips: {', '.join(f'{policy} {x}' for policy, x in of.items())}."]


def _right(groups: Groups) -> Reference:
    return Reference(label="right", y=5.0)


def _worth(label: str) -> list[Part]:
    ranks = f"Rank correlation on clips of other policies; ratings fitted: {label}"
    return [
        _table(f"Rating of states; ratings fitted: {label}", figures.RATED, last=_truth),
        _table(ranks, figures.RANKS, notes=_true_ratings),
        _bars(label, "own states", f"The demo's own states; fitted: {label}", "predicted rating", _right),
        _bars(label, OTHERS, f"Rank correlation, other moves; fitted: {label}", "Spearman"),
        _each(figures.RATED),
        _each(figures.RANKS),
    ]


def _differences(label: str) -> list[Part]:
    return [
        _table(
            f"{what}, less {PAPERS_CHOICE}; ratings: {label}", which, figures.difference,
            without=PAPERS_CHOICE,
        )
        for what, which in _COMPARED.items()
    ]  # fmt: skip


def _pooled(groups: Groups, name: str, key: str) -> np.ndarray:
    """All seeds together."""
    return np.sum([o.result["variants"][key] for o in groups[name] if o.result], axis=0)


def _confusion(label: str) -> list[Part]:
    def tables(groups: Groups) -> Iterable[Block]:
        for name in (PAPERS_CHOICE, OURS):
            counts = _pooled(groups, name, "confusion").tolist()
            yield Table(
                title=f"{name}; ratings: {label}",
                heads=("given", *(f"predicted {k}" for k in range(1, CLASSES + 1))),
                rows=[[str(k), *map(str, row)] for k, row in enumerate(counts, start=1)],
            )

    return [tables]


def _reliability(label: str) -> list[Part]:
    def chart(groups: Groups) -> Iterable[Block]:
        lines = [Line(label="as it should be", x=[0, 100], y=[0, 100], colour="#8a94a3", dashed=True)]
        for name in (PAPERS_CHOICE, "ordinal, 3 networks", OURS):
            bins = _pooled(groups, name, "reliability")
            clips, chances, happened = bins[:, bins[0] >= _ENOUGH]
            lines.append(Line(label=name, x=100 * chances / clips, y=100 * happened / clips, marks=True))
        yield Chart(
            name=f"reliability-{label}".replace(" ", "-"), title=f"Rated 3 or more; ratings: {label}",
            x_label="predicted chance, %", y_label="share of clips, %", lines=lines, wide=False,
        )  # fmt: skip

    return [chart]


def _of_both(made: Callable[[str], list[Part]], heading: str = "") -> list[Part]:
    """Parts about the predictors that were fitted on each kind of ratings."""
    return [Section(heading.format(label), made(label), _variants(label)) for label in _DATA]


def _data(groups: Groups) -> dict[str, Any]:
    """Everything by ratings, predictor and figure."""
    recorded = {head: pick for head, pick in figures.FIGURES.items() if head not in figures.CONTRAST}

    def record(group: Sequence[Outcome]) -> dict[str, Any]:
        over = {head: spread(group, pick) for head, pick in recorded.items()}
        return {h: {"mean": s.mean, "deviation": s.deviation, "each": s.values} for h, s in over.items()}

    return {
        "figures": {
            label: {name: record(each) for name, each in figures.by_variant(group).items()}
            for label, group in groups.items()
        }
    }


TABLE = parts.Experiment(
    title="onedemo: how well ratings are predicted (Table 1)", seeds=5, plan=plan, data=_data,
    parts=[
        Text(_INTRODUCTION),
        Heading("In short"),
        _findings,
        *_of_both(_accuracy, "Ratings: {}"),
        Heading("What it is worth as a reward"),
        Text(_WORTH_TEXT),
        *_of_both(_worth),
        Heading("Differences, seed by seed"),
        Text(_DIFFERENCES_TEXT),
        *_of_both(_differences),
        Heading("What is taken for what"),
        Text(_CONFUSION_TEXT),
        *_of_both(_confusion),
        Heading("Whether its chances are right"),
        Text(_RELIABILITY_TEXT),
        *_of_both(_reliability),
        Heading("Definitions"),
        Bullets(_DEFINITIONS),
    ],
)  # fmt: skip
