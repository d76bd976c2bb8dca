"""The HTML of the Rate tab. Pure: what is shown follows from the arguments."""

from __future__ import annotations

from html import escape

from onedemo.app.annotation.rating_session import Desk
from onedemo.app.annotation.scale import ANSWERS, REASONS
from onedemo.app.annotation.tutorial import Lesson
from onedemo.app.ui.clip_player import example_address, player_html
from onedemo.types import Demo, Status

SUBMIT = '<div class="od-submit"><button type="button" class="od-button" data-submit>Submit</button></div>'
_QUESTION = "How alike are the two movements?"


def top_html(count: int, target: int, *, asking: bool) -> str:
    """The question, if there is something to rate, and how far the ratings have come."""
    share = min(1.0, count / target) if target else 0.0
    question = _QUESTION if asking else ""
    progress = f"<b>{count}</b> of {target}" if count < target else f"<b>{count}</b>, as many as asked for"
    return (
        f'<div class="od-rate-top"><h1>{question}</h1>'
        f'<div class="od-progress"><span>{progress}</span>'
        f'<i role="progressbar" aria-label="Ratings so far" aria-valuemin="0" aria-valuemax="{target}" '
        f'aria-valuenow="{count}"><i style="width:{100 * share:.1f}%"></i></i></div></div>'
    )


def clip_html(clip: int, version: str, fps: float, problem: str, mark: tuple[int, int] | None = None) -> str:
    """The clip and its time bar, with what is marked on it: first picture, picture after the last."""
    marked = f' data-mark="{mark[0]},{mark[1]}"' if mark is not None else ""
    attributes = f'data-clip="{clip}"{marked}'
    player = player_html(_address(clip, version), fps, "left", "right", attributes=attributes)
    return f'<div class="od-clip">{player}{_BAR}</div>{_trouble(problem)}'


def ahead_html(upcoming: int | None, version: str) -> str:
    """The next clip, to be fetched ahead; apart, so that the clip on screen is not drawn anew for it."""
    if upcoming is None:
        return ""
    return f'<i class="od-ahead" data-ahead="{_address(upcoming, version)}"></i>'


def _address(clip: int, version: str) -> str:
    return f"/clips/{clip}.jpg?v={version}"


_BAR = (
    '<div class="od-bar"><div class="od-track" data-track>'
    '<i class="od-wrong"></i><i class="od-head"></i></div>'
    '<span class="od-bar-note">Drag where it goes wrong, if you like</span>'
    '<button type="button" class="od-clear" data-unmark hidden>Clear mark</button></div>'
)


def answers_html() -> str:
    """The five answers; each presses its key."""
    answers = "".join(
        f'<button type="button" data-key="{value}"><kbd>{value}</kbd><span>{answer}</span></button>'
        for value, answer in enumerate(ANSWERS, start=1)
    )
    return f'<div class="od-answers" role="group" aria-label="Your rating">{answers}</div>'


def waiting_html(status: Status, count: int, problem: str) -> str:
    """Why there is no clip, and for how long."""
    if status.target_ratings and count >= status.target_ratings:
        body = (
            '<div class="od-mark od-done" aria-hidden="true"></div>'
            "<h2>Thank you. That is all we asked for.</h2>"
            "<p>The robot goes on practising with your ratings. You can close this page.</p>"
        )
    else:
        wait = status.next_clips_s
        when = f" New pairs in about {_seconds(wait)}." if wait is not None else ""
        body = (
            '<div class="od-mark od-busy" aria-hidden="true"></div><h2>Nothing to rate just now</h2>'
            f"<p>{escape(status.message)}{when}</p><p class=od-quiet>They will appear here by themselves.</p>"
        )
    return f'<div class="od-waiting" role="status">{body}{_trouble(problem)}</div>'


def tools_html(*, rating: bool, can_undo: bool, practising: bool = False, marking: bool = True) -> str:
    """Undo, skip, replay, slow motion, single frames, keys."""
    undo = "" if practising else _tool("Undo", "U", 'data-key="u"' + ("" if can_undo else " disabled"))
    if not rating:
        return f'<div class="od-tools">{undo}</div>'
    buttons = (
        undo,
        _tool("Skip practice" if practising else "Skip", "S", 'data-key="s"'),
        _tool("Replay", "Space", "data-replay"),
        _tool("Slow", "F", 'data-slow aria-pressed="false"'),
        _tool("Step back", "←", 'data-step="-1"'),
        _tool("Step on", "→", 'data-step="1"'),
        _tool("Mark", "M", "data-mark") if marking and not practising else "",
        _tool("Keys", "?", "data-help"),
    )
    return f'<div class="od-tools" role="group" aria-label="Tools">{"".join(buttons)}</div>'


def _tool(label: str, key: str, attributes: str) -> str:
    return f'<button type="button" class="od-button" {attributes}>{label} <kbd>{key}</kbd></button>'


def notice_html(desk: Desk) -> str:
    """In the place of the question: what the last press did, where that is not plain; after a skip, why."""
    if desk.skipped is not None:
        return _why_html(desk.skipped)
    told = ""
    if desk.explained:
        told = "Noted. Thank you."
    elif desk.taken_back is not None:
        value = desk.taken_back.value
        before = "skipped it" if value is None else f"said <b>{value}: {ANSWERS[value - 1]}</b>"
        told = f"Taken back: you had {before}. What do you say now?"
    return f'<div class="od-notice" role="status"><span>{told}</span></div>' if told else ""


def _why_html(clip: int) -> str:
    reasons = "".join(
        f'<button type="button" class="od-chip" data-reason="{escape(reason)}">{escape(reason)}</button>'
        for reason in REASONS
    )
    return (
        f'<div class="od-notice" data-clip="{clip}" role="group" aria-label="Why was it skipped?">'
        f"<span>Skipped. Why?</span>{reasons}"
        '<input type="text" maxlength="200" placeholder="Something else" aria-label="Another reason"></div>'
    )


def lesson_top_html(number: int, of: int) -> str:
    """Where somebody is in the practice."""
    return (
        f'<div class="od-rate-top"><h1>{_QUESTION}</h1>'
        f'<div class="od-progress"><span>Practice <b>{number}</b> of {of}: nothing is saved</span></div>'
        "</div>"
    )


def lesson_html(lesson: Lesson, demo: Demo, problem: str) -> str:
    """A practice clip: both sides are moments of the video; once answered, what to say of it."""
    source = example_address(lesson.exercise.example, demo.sha256)
    player = player_html(
        source, demo.fps, "left", "right", captions={"left": "From the video", "right": "Compare"}
    )
    said = ""
    if lesson.answer is not None:
        right = "od-right-answer" if lesson.answer in lesson.exercise.right else "od-other-answer"
        last = lesson.index + 1 == len(lesson.exercises)
        said = (
            f'<div class="od-feedback {right}" role="status"><p>{escape(lesson.feedback)}</p>'
            f'<button type="button" class="od-button od-primary" data-key="g" data-go>'
            f"{'Start rating' if last else 'Next'} <kbd>Enter</kbd></button></div>"
        )
    return f'<div class="od-clip od-practice">{player}</div>{said}{_trouble(problem)}'


def _trouble(problem: str) -> str:
    return f'<p class="od-problem" role="alert">{escape(problem)}</p>' if problem else ""


def _seconds(value: float) -> str:
    return f"{max(1, round(value))} s" if value < 90 else f"{round(value / 60)} minutes"
