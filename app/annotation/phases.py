"""What people are told of the training: the name of each phase, what is awaited and what one can do. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from onedemo.types import Status

NAMES = {
    "starting": "Starting", "pretrain": "Waiting for ratings", "online": "Practising", "pausing": "Pausing",
    "paused": "Paused", "stopping": "Stopping", "stopped": "Stopped", "done": "Done", "failed": "Failed",
}  # fmt: skip
"""What each phase is called, on all tabs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Waiting:
    """What stands in the place of a clip while there is none."""

    title: str
    """What is awaited."""
    text: str
    """How far it is, in one or two sentences."""
    advice: str
    """What one can do, one sentence."""
    busy: bool = True
    """Whether anything goes on that ends the waiting."""
    progress: float | None = None
    """How much of it is done, 0 to 1; None if that is not known."""


def told(status: Status) -> str:
    """What goes on in a run and what a researcher can do about it: one or two sentences."""
    match status.phase:
        case "starting":
            return _starting(status)
        case "pretrain":
            missing = max(0, status.pretrain_ratings - status.ratings)
            return f"The robot moves at random. It starts practising after {_ratings(missing, 'more')}."
        case "online":
            return f"The robot practises with what was learned from the ratings.{_unstable(status)}"
        case "pausing":
            return f"{_iteration_ends(status)} Then practice rests; clips can still be rated."
        case "paused":
            return "Practice rests until it is resumed. Clips can still be rated."
        case "stopping":
            return f"{_iteration_ends(status)} Then the run stops; nothing is lost."
        case "stopped":
            return "Nothing goes on until the run is resumed, from where it was."
        case "done":
            return f"The robot has practised as long as it was told to.{_unstable(status)}"
        case _ if not status.saved:
            return "Nothing is saved any more. Stop onedemo, and do what its log says."
        case _:
            return "It is tried again automatically. Ratings are kept, and clips can still be rated."


def _unstable(status: Status) -> str:
    if not status.unstable:
        return ""
    episodes = f"{status.unstable:,} episode{'' if status.unstable == 1 else 's'}"
    return f" {episodes} ended early as the physics became unstable: its model needs a smaller timestep."


def waiting(status: Status, *, used: int, researcher: bool, taken: bool = False) -> Waiting:
    """What somebody who would rate is told while there is no clip.

    Args:
        status: Of the run.
        used: Ratings that are used for training.
        researcher: Who waits may resume the run.
        taken: There are clips, but others have them on their screens.
    """
    phase, target = status.phase, status.target_ratings
    stay, later = "Leave this page open, or come back later.", "They appear here automatically."
    resume = "Resume it on Watch." if researcher else (
        "The researcher can resume it. You can close this page: your ratings are kept."
    )  # fmt: skip
    first = status.iteration == 0 and used >= status.pretrain_ratings > 0
    if not status.saved:
        return Waiting(
            title="Ratings cannot be saved", text="Nothing that is answered now is kept.", busy=False,
            advice="Stop onedemo, and do what its log says." if researcher
            else "Please stop, and tell the researcher.",
        )  # fmt: skip
    if phase == "done" or 0 < target <= used:
        return Waiting(
            title="Thank you. That is all we asked for.", text=_afterwards(status), busy=False,
            advice="Watch shows how far the robot is." if researcher else "You can close this page.",
        )  # fmt: skip
    if phase == "stopped":
        text = "There are no new clips until it is resumed."
        return Waiting(title="The run is stopped", text=text, busy=False, advice=resume)
    if phase == "stopping":
        return Waiting(title="The run is being stopped", text=_iteration_ends(status), advice=resume)
    if taken:
        return Waiting(
            title="Others are rating the last clips",
            text="Each clip is asked of one person at a time. One comes here as soon as it is free, after "
            "two minutes at the latest, or when there are new ones.", advice=stay,
        )  # fmt: skip
    if phase == "failed":
        return Waiting(
            title="The robot’s practice has failed",
            text="It is tried again automatically. All ratings are kept; new clips come when it works.",
            advice="The reason is above and in the log." if researcher else stay,
        )  # fmt: skip
    if first and phase == "starting":
        return Waiting(
            title="The robot is about to practise",
            text=f"The {_ratings(status.pretrain_ratings)} that it needs for that are there. "
            f"{_starting(status)} Then it practises, and the next clips show what it has learned.",
            advice=stay, progress=status.progress,
        )  # fmt: skip
    if first and phase == "paused":
        text = "The next clips show what the robot does once it has practised."
        return Waiting(title="Practice is paused", text=text, busy=False, advice=resume)
    if phase == "pausing":
        text = f"{_iteration_ends(status)} Then there are a few new clips."
        return Waiting(title="Practice is being paused", text=text, advice=resume)
    if first:
        return Waiting(
            title="The robot practises for the first time",
            text=f"It learns from the {_ratings(used)} so far. The next {target - used} are about what it "
            f"does then. {_new_clips(status)}", advice=stay,
        )  # fmt: skip
    if phase == "online":
        return Waiting(
            title="No clip to rate just now",
            text=f"The robot is practising, and new clips show what it does. {_new_clips(status)}",
            advice=later,
        )  # fmt: skip
    return Waiting(title="The next clips are being drawn", text="That takes a few seconds.", advice=later)


def waiting_for_pairs(status: Status, *, researcher: bool) -> Waiting:
    """The same for somebody who would compare: pairs are made of rollouts, while somebody waits for them."""
    if status.phase in ("stopped", "stopping") or not status.saved:
        return waiting(status, used=0, researcher=researcher)
    text = "They are cut from what the robot did last, and drawn."
    if status.phase == "online":
        text += f" {_new_clips(status, 'pairs')}"
    elif status.phase in ("failed", "starting"):
        text += f" {told(status)}"
    return Waiting(title="The next pairs are being made", text=text, advice="They appear here automatically.")


def duration(seconds: float) -> str:
    """Seconds in words: about 12 s, about 3 minutes."""
    if seconds < 90:
        return f"about {max(1, round(seconds))} s"
    return f"about {round(seconds / 60)} minutes"


def _starting(status: Status) -> str:
    text = status.message or "The run is being opened."
    if status.progress is None:
        return text
    left = f", {duration(status.left_s)} left" if status.left_s is not None else ""
    return f"{text} {status.progress:.0%} done{left}."


def _afterwards(status: Status) -> str:
    match status.phase:
        case "done":
            return "The robot has practised as long as it was told to."
        case "online" | "pretrain":
            return "The robot practises with your ratings."
        case "starting":
            return f"The robot soon practises with your ratings. {_starting(status)}"
        case "failed":
            return "Your ratings are kept. The robot’s practice has failed, and is tried again."
        case _:
            return "Your ratings are kept; the robot practises with them when its run is resumed."


def _iteration_ends(status: Status) -> str:
    when = f"in {duration(status.next_clips_s)}" if status.next_clips_s is not None else "first"
    return f"The iteration ends {when}."


def _new_clips(status: Status, what: str = "clips") -> str:
    if status.next_clips_s is None:
        return f"New {what} come as soon as it is through."
    return f"New {what} in {duration(status.next_clips_s)}."


def _ratings(count: int, word: str = "") -> str:
    return f"{count} {word + ' ' if word else ''}rating{'' if count == 1 else 's'}"
