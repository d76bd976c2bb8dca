"""What people are told, in every phase, as annotator and as researcher: what is awaited, how far it is."""

from __future__ import annotations

import itertools

import pytest

from onedemo.app.annotation.phases import NAMES, duration, told, waiting, waiting_for_pairs
from onedemo.types import HALTED, Status

HALTS = "paused pausing stopped stopping".split()


def status(phase, **more):
    known = {"pretrain_ratings": 8, "target_ratings": 14, "iteration": 3, "ratings": 5}
    return Status(phase=phase, **known | more)


@pytest.mark.parametrize("phase", NAMES)
@pytest.mark.parametrize("researcher", [False, True])
def test_every_phase_says_what_is_awaited_and_what_one_can_do(phase, researcher):
    for used, iteration, taken, seconds in itertools.product((0, 9, 14), (0, 3), (False, True), (None, 5.0)):
        state = status(phase, iteration=iteration, ratings=used, next_clips_s=seconds)
        said = waiting(state, used=used, researcher=researcher, taken=taken)
        for text in (said.title, said.text, said.advice, told(state)):
            assert text and text[0].isupper() and "  " not in text and "None" not in text and "_" not in text
        for text in (said.text, said.advice, told(state)):
            assert text.endswith(".")
        words = f"{said.title} {said.text} {said.advice}"
        # Nothing comes by itself where it does not: a stopped run, or all that was asked for.
        ends = used >= 14 or phase in ("done", "stopped")
        assert not (ends and ("automatically" in said.advice or said.busy))
        if phase in HALTS and "Watch" in words:
            assert researcher  # an annotator has no such tab
        if phase in ("stopped", "stopping") and used < 14:
            assert "esume it" in said.advice
        pairs = waiting_for_pairs(state, researcher=researcher)
        assert pairs.text and (phase not in ("stopped", "stopping") or "stopped" in pairs.title)


def test_a_stopped_run_promises_no_clips():
    said = waiting(status("stopped"), used=5, researcher=False)
    assert said.title == "The run is stopped" and "The researcher can resume it" in said.advice
    assert not said.busy and "automatically" not in f"{said.text}{said.advice}"
    assert waiting(status("stopped"), used=5, researcher=True).advice == "Resume it on Watch."


def test_the_online_share_is_said_to_wait_for_the_first_practice():
    said = waiting(status("online", iteration=0), used=8, researcher=False)
    assert said.title == "The robot practises for the first time"
    assert "8 ratings so far" in said.text and "next 6 are about what it does" in said.text
    looking = status(
        "starting", iteration=0, message="Pictures are looked at.", progress=0.4, left_s=31.2
    )  # fmt: skip
    said = waiting(looking, used=8, researcher=False)
    assert "8 ratings that it needs for that are there" in said.text and said.progress == 0.4
    assert "Pictures are looked at. 40% done, about 31 s left." in said.text
    # Before that share is given, clips are only being drawn.
    assert waiting(looking, used=3, researcher=False).title == "The next clips are being drawn"


def test_pausing_and_stopping_say_when_the_iteration_ends():
    for phase in ("pausing", "stopping"):
        assert told(status(phase, next_clips_s=5.0)).startswith("The iteration ends in about 5 s.")
        assert "The iteration ends in about 5 s." in waiting(
            status(phase, next_clips_s=5.0), used=5, researcher=False
        ).text  # fmt: skip


def test_what_others_have_on_their_screens_is_said_to_be_with_them():
    assert waiting(status("pretrain"), used=5, researcher=False, taken=True).title.startswith("Others")
    assert waiting(status("stopped"), used=5, researcher=False, taken=True).title == "The run is stopped"


def test_a_database_that_is_gone_asks_to_stop():
    state = status("failed", saved=False)
    assert "Please stop" in waiting(state, used=5, researcher=False).advice
    assert "automatically" not in told(state)


def test_phases_that_can_be_left_by_resume_have_names():
    assert set(HALTED) < set(NAMES)


def test_durations_are_rough():
    assert [duration(s) for s in (0.2, 12.4, 89, 91, 480)] == [
        "about 1 s", "about 12 s", "about 89 s", "about 2 minutes", "about 8 minutes",
    ]  # fmt: skip
