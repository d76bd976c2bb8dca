"""What a browser may say of a clip; and the way through the practice clips."""

from __future__ import annotations

import json

import pytest

from onedemo.app.annotation import presses
from onedemo.app.annotation.examples import Example
from onedemo.app.annotation.presses import read_press
from onedemo.app.annotation.tutorial import Lesson

PAGE = {"page": "p", "id": "1"}
RATE = PAGE | {"press": "rate", "clip": 7, "value": 3}
REASON = PAGE | {"press": "reason", "clip": 7, "reason": "too dark"}
PAIR_REASON = PAGE | {"press": "pair reason", "pair": 7, "reason": "too dark"}
PRACTISE = PAGE | {"press": "practise", "exercise": 0, "do": 4}


def read(body):
    return read_press(json.dumps(body).encode())


def test_every_kind_of_press_is_read():
    assert read(RATE | {"mark": [0, 3]}) == presses.Rate(page="p", id="1", clip=7, value=3, mark=(0, 3))
    assert read(RATE | {"mark": None}) == presses.Rate(page="p", id="1", clip=7, value=3)
    assert read(REASON) == presses.Explain(page="p", id="1", clip=7, reason="too dark")
    assert read(PAIR_REASON) == presses.ExplainPair(page="p", id="1", pair=7, reason="too dark")
    assert read(PRACTISE).do == 4 and read(PRACTISE | {"do": "next"}).do == "next"
    for kind in ("skip", "undo"):
        assert read(PAGE | {"press": kind, "clip": 7}).clip == 7
    assert read(PAGE | {"press": "compare", "pair": 7, "answer": "equal"}).answer == "equal"


@pytest.mark.parametrize(
    "body",
    [
        {}, [], "x", None, RATE | {"more": 1}, RATE | {"clip": "7"}, RATE | {"clip": True},
        RATE | {"clip": 0},
        RATE | {"clip": 2**53}, RATE | {"value": 0}, RATE | {"value": 6}, RATE | {"value": 2.5},
        RATE | {"mark": [1]}, RATE | {"mark": ["0", "1"]}, RATE | {"mark": [0.5, 1]},
        RATE | {"mark": [-1, 2]},
        RATE | {"page": ""}, RATE | {"page": "x" * 65}, RATE | {"id": 5}, RATE | {"press": "exclude"},
        {key: value for key, value in RATE.items() if key != "page"},
        REASON | {"reason": 7}, REASON | {"reason": " "}, REASON | {"reason": "a\nb"},
        REASON | {"reason": "x" * 201}, PRACTISE | {"do": "x"}, PRACTISE | {"exercise": -1},
        PAGE | {"press": "compare", "pair": 7, "answer": "both"}, PAIR_REASON | {"reason": "a\nb"},
    ],
)  # fmt: skip
def test_anything_else_is_refused(body):
    with pytest.raises(ValueError):
        read(body)


@pytest.mark.parametrize("body", [b"", b"\xff", b"[" * 5000, b'{"clip": 1e999}'])
def test_what_is_no_json_is_refused(body):
    with pytest.raises(ValueError):
        read_press(body)


def clips(*ratings):
    return tuple(Example(left=9 * n, right=40 + 9 * n, rating=r, why="So.") for n, r in enumerate(ratings))


def test_introduction_and_practice_are_gone_through_by_presses_that_name_them():
    lesson = Lesson(lambda: clips(5, 1))
    assert lesson.introducing and not lesson.take(0, 3) and not lesson.take(1, 3)
    assert lesson.take(0, "next") and not lesson.introducing
    assert not lesson.take(1, "next") and not lesson.take(2, 3)
    assert lesson.take(1, 5) and lesson.answer == 5
    assert not lesson.take(1, 4)  # once
    assert lesson.take(1, "next") and not lesson.take(1, "next")
    assert lesson.take(2, 1) and lesson.take(2, "next") and lesson.over
    assert not lesson.take(3, 1)
    lesson.begin()  # again: without the introduction
    assert not lesson.over and not lesson.introducing and lesson.take(1, "leave") and lesson.over


def test_practice_takes_the_clips_that_are_known_when_it_begins():
    known = clips(5)
    lesson = Lesson(lambda: known)
    known = clips(5, 1, 3)
    assert lesson.take(0, "next") and len(lesson.exercises) == 3


def test_feedback_says_what_is_true_of_the_answer():
    lesson = Lesson(lambda: clips(3))
    for given, said in (
        (3, "3 is what most people would give."),
        (4, "4 is near enough; most people would give 3."),
        (1, "You gave 1; most people would give 3."),
    ):
        lesson.begin()
        lesson.take(1, given)
        assert lesson.feedback == f"{said} So."
