"""No module outside ``trainer/robots`` names a robot, but for those listed here and why."""

import io
import re
import tokenize

from helpers.paths import ROOT

ALLOWED = {
    # The demos that come with the program are called after their robot, and one of them is the default.
    "app/cli/run.py", "trainer/experiments", "trainer/demos/ground_truth.py",
    # A setting's default, and one of the commands' own help.
    "trainer/config.py",
    # The hand-coded rewards and searches by which the demos of the hopper were made.
    "trainer/baselines", "trainer/sim/task_rewards.py",
    # Their docstrings say what holds where no robot is named.
    "app/annotation/examples.py", "trainer/demos/edits.py", "trainer/demos/library.py", "trainer/types.py",
    # What was measured with the hopper is said of the hopper.
    "trainer/sim/vector_env.py", "trainer/sim/warp_physics.py", "trainer/rl/policy_inputs.py",
}  # fmt: skip
"""Files and packages, from the top of the repository."""
BEING_FREED = {
    "trainer/evaluation", "trainer/reward", "trainer/vision", "trainer/annotators", "trainer/render",
    "app/services/live_rollout.py",
    "app/services/demo_images.py",
}  # fmt: skip
"""Those that still do although they need not: to be struck off as they are freed."""
_NAMED = re.compile(r"hopper|walker2d|cheetah|humanoid|\bswimmer\b|[\"']ant[\"']", re.IGNORECASE)


def named(file):
    """Lines of code or text, comments left out, that name a robot."""
    text = file.read_text()
    if not _NAMED.search(text):
        return []
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [
        t.start[0] for t in tokens if t.type in (tokenize.NAME, tokenize.STRING) and _NAMED.search(t.string)
    ]


def test_no_other_module_names_a_robot():
    naming = set()
    for folder in ("trainer", "app"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            place = file.relative_to(ROOT).as_posix()
            if not place.startswith("trainer/robots/") and (lines := named(file)):
                naming.add((place, tuple(lines)))
    strange = [
        f"{place}, lines {lines}"
        for place, lines in sorted(naming)
        if not any(place == listed or place.startswith(f"{listed}/") for listed in ALLOWED | BEING_FREED)
    ]
    assert not strange
    idle = [
        listed for listed in ALLOWED
        if not any(place == listed or place.startswith(f"{listed}/") for place, _ in naming)
    ]  # fmt: skip
    assert not idle, "they name none any more: strike them off"
