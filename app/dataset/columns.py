"""What is in an exported data set, column by column. The data card and the documentation are made of this."""

from __future__ import annotations

RATINGS: dict[str, str] = {
    "id": "Number of the rating; ascending in time.",
    "clip_id": "Clip that was rated; key of the segments.",
    "run": "Training that the clip belongs to.",
    "demo": "Name of the demonstration video.",
    "rater": "Name of the rater.",
    "value": "1 (not at all similar) to 5 (the same).",
    "stage": "pretrain: random motion; online: the policy in training.",
    "iteration": "Iteration of the policy whose motion the clip shows; 0 in pretrain.",
    "created_at": "When the rating was given: UTC, ISO 8601, milliseconds.",
    "latency_ms": "From the clip on screen to the press, milliseconds.",
    "snapshot": "Version of the reward model at that time; 0: none.",
    "predicted": "What that reward model predicted, 1 to 5; empty: none.",
    "demo_step": "Control step of the demonstration at which the clip begins.",
    "steps": "Length of the clip, control steps.",
    "repeat": "1: the same person's second opinion, which nothing learns from; else 0.",
    "mark_start": "Where the clip goes wrong, seconds from its start; empty: not said.",
    "mark_end": "End of that stretch, seconds from the start of the clip.",
    "choice": "Why the clip was asked: any, high (predicted rating), disagreement; empty: not kept.",
    "score": "Predicted rating or disagreement that it was chosen by; empty: by chance.",
    "left_out": "1: a researcher has left the rater out of training; else 0.",
}
"""Of the CSV, in order."""

SEGMENTS: dict[str, str] = {
    "clip_id": "Clip; key.",
    "run": "Training that it belongs to.",
    "demo_step": "Control step of the demonstration at which it begins.",
    "stage": "pretrain or online.",
    "iteration": "Iteration of the policy whose motion it shows.",
    "snapshot": "Version of the reward model when it was asked; 0: none.",
    "predicted": "What that reward model predicted, 1 to 5.",
    "choice": "Why it was asked.",
    "score": "What it was chosen by.",
    "obs": "Observations before each step: positions but for the place on the floor, and velocities.",
    "actions": "Actions as the policy gave them, not clipped: -1 to 1 is what a motor can do.",
    "qpos": "Positions before each step, metres and radians, as in the robot's MuJoCo model.",
    "qvel": "Velocities before each step, metres/s and radians/s, as there.",
}
"""Of the Parquet file of clips, in order; the last four are lists of rows."""

PAIRS: dict[str, str] = {
    "pair_id": "Pair; key.",
    "run": "Training that it belongs to.",
    "demo_step": "Control step of the demonstration at which both clips begin.",
    "stage": "pretrain or online.",
    "iteration": "Iteration of the policy whose motion the clips show.",
    **{
        f"{side}_{name}": f"{what} of the {side} clip, as `{name}` of the segments."
        for side in ("left", "right")
        for name, what in (
            ("obs", "Observations"),
            ("actions", "Actions"),
            ("qpos", "Positions"),
            ("qvel", "Velocities"),
        )
    },
}
"""Of the Parquet file of pairs, in order; the last eight are lists of rows."""


SKIPS: dict[str, str] = {
    "id": "Number of the skip, among those of the ratings; ascending in time.",
    "clip_id": "Clip that was not rated.",
    "run": "Training that the clip belongs to.",
    "demo": "Name of the demonstration video.",
    "rater": "Name of the rater.",
    "reason": "Why, in the rater’s words; empty: not said.",
    "stage": "pretrain: random motion; online: the policy in training.",
    "iteration": "Iteration of the policy whose motion the clip shows; 0 in pretrain.",
    "created_at": "When it was skipped, or the reason given: UTC, ISO 8601, milliseconds.",
    "latency_ms": "From the clip on screen to the press, milliseconds.",
    "demo_step": "Control step of the demonstration at which the clip begins.",
    "steps": "Length of the clip, control steps.",
    "repeat": "1: a repeat: the same person was asked again; else 0.",
    "snapshot": "Version of the reward model at that time; 0: none.",
    "predicted": "What that reward model predicted, 1 to 5; empty: none.",
}
"""Of the CSV of skips, in order."""


COMPARISONS: dict[str, str] = {
    "id": "Number of the answer; ascending in time.",
    "pair_id": "Pair of clips.",
    "run": "Training that the pair belongs to.",
    "demo": "Name of the demonstration video.",
    "rater": "Name of the rater.",
    "answer": "Which clip is closer to the video: left, right, or equal.",
    "stage": "pretrain: random motion; online: the policy in training.",
    "iteration": "Iteration of the policy whose motion the clips show; 0 in pretrain.",
    "created_at": "When the answer was given: UTC, ISO 8601, milliseconds.",
    "latency_ms": "From the pair on screen to the press, milliseconds.",
    "demo_step": "Control step of the demonstration at which the clips begin.",
    "steps": "Length of each clip, control steps.",
}
"""Of the CSV of comparisons, in order."""


HISTORY: dict[str, str] = {
    "id": "Number of the event, among those of the ratings or, with a pair, of the comparisons.",
    "clip_id": "Clip that it is about; empty: none.",
    "pair_id": "Pair that it is about; empty: none.",
    "run": "Training that it belongs to.",
    "rater": "Name of the rater that it is of or, without clip and pair, about.",
    "kind": "rate, skip, undo, leave out, take in; of a pair: left, right, equal, skip, undo.",
    "value": "Of a rating, 1 to 5.",
    "repeat": "1: the same person's second opinion; else 0.",
    "mark_start": "Where the clip goes wrong, seconds from its start; empty: not said.",
    "mark_end": "End of that stretch, seconds from the start of the clip.",
    "reason": "Of a skip, in the rater’s words.",
    "snapshot": "Version of the reward model at that time; 0: none.",
    "predicted": "What that reward model predicted, 1 to 5; empty: none.",
    "latency_ms": "From the clip or pair on screen to the press, milliseconds.",
    "created_at": "When it was: UTC, ISO 8601, milliseconds.",
    "by": "Who left a rater out, took one in or withdrew a rating; empty: the command line, or nobody.",
    "withdrawn": "Of an undo: why a researcher withdrew the rating.",
}
"""Of the CSV of what does not hold any more, in order."""


def as_table(columns: dict[str, str]) -> str:
    """Columns as a Markdown table."""
    rows = "\n".join(f"| `{name}` | {meaning} |" for name, meaning in columns.items())
    return f"| column | meaning |\n|---|---|\n{rows}\n"
