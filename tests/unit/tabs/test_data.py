"""The Data tab's figures as HTML: verdicts in words, small charts, names that are text."""

from onedemo.app.annotation.agreement import (
    RatingRow,
    differences,
    disputed,
    quality,
    quality_by_rater,
    trends,
)
from onedemo.app.tabs.data import data_html, line
from onedemo.storage.rating_counts import Counts
from onedemo.types import Rater

HOSTILE = "<img src=x>"


def html_of(values):
    """Of two people's ratings of 40 clips: values(clip) gives those of the two."""
    rows = [
        RatingRow(clip, name, value, False, 1500, 3.0, 304.0)
        for clip in range(40)
        for name, value in zip((HOSTILE, "Bob"), values(clip), strict=True)
    ]
    given = {name: Counts(classes=(8,) * 5) for name in (HOSTILE, "Bob")}
    people = {name: Rater(id=k, name=name, role="annotator") for k, name in enumerate((HOSTILE, "Bob"), 1)}
    return data_html(
        "r", "onedemo", {(name, "online"): [1] * 5 for name in people}, quality(rows),
        quality_by_rater(rows, intervals=False), given, people, {2}, trends(rows), disputed(rows),
        differences(rows),
    )  # fmt: skip


def test_agreement_is_said_in_words_with_its_thresholds():
    same, opposite = (
        html_of(values) for values in (lambda c: (c % 5 + 1,) * 2, lambda c: (c % 5 + 1, 5 - c % 5))
    )
    assert 'data-verdict="good">good</b>' in same and 'data-verdict="poor">poor</b>' in opposite
    assert "good from 0.80, fair from 0.67, poor below" in same
    assert "No clip has been rated two points apart" in same


def test_clips_that_people_disagree_on_can_be_played_and_names_are_text():
    page = html_of(lambda c: (c % 5 + 1, 5 - c % 5))
    assert 'data-clip-look="39"' in page and "4 points apart" in page
    assert "points apart on" in page and "-0.0" not in page and "+0.0" not in page
    assert HOSTILE not in page and "&lt;img src=x&gt;" in page
    assert "excluded from training" in page and "during practice" in page


def test_a_line_has_gaps_where_nothing_is_known_and_stays_inside():
    assert line([1.0, 3.0, None, 9.0], 1.0, 5.0) == [[(0.0, 100.0), (33.3, 50.0)], [(100.0, 0.0)]]
    assert line([None, None], 0.0, 1.0) == [] and line([2.0], 1.0, 5.0) == [[(0.0, 75.0)]]
