"""A user's own rater: what it is given, and one clear sentence for everything that can be wrong with it."""

import sys

import numpy as np
import pytest

from helpers.small_world import STEPS, Thumbnail, falling_demo, small_config
from onedemo.annotators.base import RatingBudgetSpent
from onedemo.annotators.oracle import make_rater
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import read_frames
from onedemo.errors import UserError
from onedemo.render.clip_image import fit
from onedemo.render.renderer import Renderer
from onedemo.storage.store import Store
from onedemo.training.simulated_run import train
from onedemo.types import Segment
from unit.annotators.test_scripted import Untouchable

SOURCE = """
import numpy as np

class Height:
    seen = []

    def rate(self, demo_frames, agent_frames, segment):
        Height.seen.append((demo_frames, agent_frames, segment))
        if round(1e4 * segment.qpos[0, 1]) % 4 == 0:
            return None
        return np.int64(1 + 4 * (segment.qpos[:, 1].mean() > 0.8))

class Decided:
    answer = 3
    def rate(self, demo_frames, agent_frames, segment):
        return self.answer

class Broken(Decided):
    def rate(self, demo_frames, agent_frames, segment):
        raise RuntimeError("no\\n  idea")

class Fussy(Decided):
    def __init__(self, taste): ...

class Mute: ...

def function(): ...
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return falling_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture
def taste(tmp_path, monkeypatch):
    """The user's module, in the current directory."""
    (tmp_path / "taste.py").write_text(SOURCE)
    (tmp_path / "bad_taste.py").write_text("import no_such_library\n")
    (tmp_path / "worse_taste.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    yield
    for name in ("taste", "bad_taste", "worse_taste"):
        sys.modules.pop(name, None)


@pytest.fixture
def segment(demo):
    hidden = load_hidden(hidden_path(demo.path))
    cut = slice(60, 98)
    return Segment(
        obs=hidden.obs[cut], actions=hidden.actions[cut], qpos=hidden.qpos[cut], qvel=hidden.qvel[cut]
    )


def make(name, demo, budget=5):
    return make_rater(name, Untouchable(), demo=demo, budget=budget)  # type: ignore[arg-type]


@pytest.mark.seam
def test_it_is_given_what_a_person_sees_and_no_hidden_states(taste, demo, segment):
    rater = make("taste:Height", demo)
    assert rater.rate(segment, 60) in (1, 5)
    ((demo_clip, agent_clip, seen),) = sys.modules["taste"].Height.seen
    # Steps 60..97 show frames 14 (60 * 0.008 * 30 = 14.4) to 23.
    expected = np.stack([fit(frame) for frame in read_frames(demo)[14:24]])
    np.testing.assert_array_equal(demo_clip, expected)
    assert demo_clip.shape == agent_clip.shape == (10, 360, 480, 3) and agent_clip.dtype == np.uint8
    firsts = [next(t for t in range(60, 98) if int(t * 0.24 + 1e-9) == f) - 60 for f in range(14, 24)]
    with Renderer() as renderer:
        np.testing.assert_array_equal(agent_clip, renderer.render(segment.qpos[firsts]))
    assert seen is segment
    rater.close()
    rater.close()


@pytest.mark.seam
def test_the_end_of_the_demo_can_be_rated(taste, demo, segment):
    rater = make("taste:Decided", demo)
    assert rater.rate(segment, STEPS - 38) == 3
    rater.close()


@pytest.mark.seam
def test_the_budget_holds_and_declined_clips_cost_nothing(taste, demo, segment):
    rater = make("taste:Decided", demo, budget=2)
    chosen = sys.modules["taste"].Decided
    assert rater.rate(segment, 0) == 3
    chosen.answer = None
    assert rater.rate(segment, 0) is None
    chosen.answer = 5
    assert rater.rate(segment, 0) == 5
    with pytest.raises(RatingBudgetSpent):
        rater.rate(segment, 0)
    rater.close()


@pytest.mark.seam
@pytest.mark.parametrize("answer", [0, 6, 3.0, "3", True, np.float64(3), np.array([1, 2])])
def test_anything_but_a_rating_is_refused(answer, taste, demo, segment):
    rater = make("taste:Decided", demo)
    sys.modules["taste"].Decided.answer = answer
    with pytest.raises(UserError, match=r"rater taste:Decided must give a whole number from 1 to 5, or None"):
        rater.rate(segment, 0)
    rater.close()


@pytest.mark.seam
def test_an_error_inside_is_told(taste, demo, segment):
    rater = make("taste:Broken", demo)
    with pytest.raises(UserError, match="rater taste:Broken failed: RuntimeError: no idea"):
        rater.rate(segment, 0)
    rater.close()


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "no_taste:Height",
            "rater no_taste:Height: there is no module 'no_taste', neither in .* nor installed",
        ),
        ("taste.deep:Height", "there is no module 'taste.deep'"),
        ("bad_taste:Height", "bad_taste cannot be imported: ModuleNotFoundError: No module named 'no_such"),
        ("worse_taste:Height", "worse_taste cannot be imported: ZeroDivisionError: division by zero"),
        ("taste:Heigth", "module 'taste' has no class 'Heigth'; did you mean Height?"),
        ("taste:function", "module 'taste' has no class 'function'"),
        ("taste:Mute", r"class Mute has no method rate\(self, demo_frames, agent_frames, segment\)"),
        ("taste:Fussy", r"Fussy\(\) failed: TypeError: .*missing 1 required"),
        ("taste:Height+mistake", "error models need a rater that measures a distance"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(name, sentence, taste, demo):
    with pytest.raises(UserError, match=sentence) as error:
        make(name, demo)
    assert "\n" not in str(error.value)


@pytest.mark.seam
def test_a_whole_run_on_a_demo_without_hidden_states(taste, tmp_path):
    person = falling_demo(tmp_path / "person")
    hidden_path(person.path).unlink()
    store = Store(tmp_path / "data")
    summary = train(
        store=store, data_dir=tmp_path / "data", demo=person, config=small_config(ratings__pretrain=8),
        encoder=Thumbnail(), rater="taste:Height", progress=False,
    )  # fmt: skip
    assert summary["ratings"] == 14 and summary["true_similarity"] is None
    assert {name for name, _ in store.ratings.tallies(summary["run"])} == {"taste:Height"}
    assert store.clips.count(summary["run"]) == len(sys.modules["taste"].Height.seen) > 14
    store.close()
