"""An export and its way back: nothing is lost on it, and the same ratings give the same predictor."""

import csv
from contextlib import closing

import numpy as np
import pyarrow.parquet as pq
import pytest

from helpers.paths import ROOT
from helpers.small_world import Thumbnail, falling_demo, small_config
from onedemo.app.cli.main import main
from onedemo.app.dataset.card import card
from onedemo.app.dataset.columns import COMPARISONS, HISTORY, PAIRS, RATINGS, SEGMENTS, SKIPS, as_table
from onedemo.config import load_config
from onedemo.reward.dataset import TrainingSet
from onedemo.storage.rating_records import RATING_COLUMNS
from onedemo.storage.store import Store
from onedemo.training.learner import Learner
from onedemo.training.rating_queue import Simulated
from onedemo.training.runs import add_run
from onedemo.training.training_run import TrainingRun


def by_rule(segment, demo_step):
    return int(np.clip(round(1 + 4 * segment.obs[:, 0].mean() + demo_step % 2), 1, 5))


def marks(segment, demo_step):
    return (4, 12) if demo_step % 3 == 0 else None


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A run that a program has rated, with people's second opinions on top; and its export."""
    directory = tmp_path_factory.mktemp("study")
    demo = falling_demo(tmp_path_factory.mktemp("demo"))
    data_dir = directory / "data"
    with closing(Store(data_dir)) as store:
        config = small_config()
        run = add_run(store, data_dir, demo, config, name="first")
        training = TrainingRun(
            store=store, data_dir=data_dir, run=run, demo=demo, config=config, encoder=Thumbnail(),
            simulated=Simulated(name="rule", rate=by_rule, mark=marks),
        )  # fmt: skip
        training.prepare()
        while training.step() != "done":
            pass
        ada, bob = store.accounts.ensure("Ada", "researcher"), store.accounts.ensure("@Bob | co", "annotator")
        first = next(clip for clip, _ in store.clips.answered()).id
        store.ratings.rate(first, bob.id, 5, 1200)
        store.ratings.rate(first, bob.id, 4, 900, repeat=True)
        store.ratings.rate(first, ada.id, 1, 700)
        store.ratings.leave_out(run, bob.id, by=ada.id)
    files = [directory / name for name in ("ratings.csv", "segments.parquet", "card.md")]
    arguments = ["export", "--data-dir", str(data_dir)]
    for option, file in zip(("--out", "--segments", "--card"), files, strict=True):
        arguments += [option, str(file)]
    assert main(arguments) == 0
    return demo, data_dir, files


def test_the_export_is_what_the_columns_say(study):
    _, data_dir, (ratings, segments, _) = study
    with ratings.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == RATING_COLUMNS == tuple(RATINGS)
    assert {row["run"] for row in rows} == {"first"} and "'@Bob | co" in {row["rater"] for row in rows}
    table = pq.read_table(segments)
    assert table.column_names == list(SEGMENTS)
    assert table.column("clip_id").to_pylist() == sorted({int(row["clip_id"]) for row in rows})
    with closing(Store(data_dir)) as store:
        clip, segment = next(iter(store.clips.answered()))
        row = table.slice(0, 1).to_pylist()[0]
        assert row["clip_id"] == clip.id and np.array_equal(np.array(row["qpos"]), segment.qpos)


def test_imported_into_an_empty_directory_it_gives_the_same_predictor(study, tmp_path, capsys):
    demo, data_dir, (ratings, segments, _) = study
    again = tmp_path / "again"
    assert main(["import", str(ratings), str(segments), "--data-dir", str(again)]) == 0
    fitted = []
    with closing(Store(data_dir)) as before, closing(Store(again)) as after:
        assert list(after.ratings.stream()) == list(before.ratings.stream())
        assert [r.role for r in after.accounts.raters()] != []
        assert {r.name: r.role for r in after.accounts.raters()} == {
            r.name: r.role for r in before.accounts.raters()
        }
        assert after.ratings.tallies("first") == before.ratings.tallies("first")
        assert capsys.readouterr().out.split()[:2] == ["1", "runs"]
        for store, directory in ((before, data_dir), (after, again)):
            config = load_config(directory / "runs" / "first" / "config.toml")
            learner = Learner(config, demo.frames, demo.fps)
            learner.look_at(np.eye(demo.frames, 64, dtype=np.float32), None)
            rated = TrainingSet(store, "first").at(store.ratings.last_event())
            fitted.append((rated, learner.fit(rated, 7)[0].tensors()))
    (one, tensors), (other, same) = fitted
    assert [(r.event, r.value, r.mark) for r in one] == [(r.event, r.value, r.mark) for r in other]
    assert any(r.mark for r in one) and len(one) > 15
    assert str(tensors) == str(same)
    flat = lambda found: np.concatenate([t.numpy().ravel() for t in leaves(found)])  # noqa: E731
    assert np.array_equal(flat(tensors), flat(same))


def leaves(tree):
    if isinstance(tree, dict):
        return [leaf for value in tree.values() for leaf in leaves(value)]
    if isinstance(tree, list):
        return [leaf for value in tree for leaf in leaves(value)]
    return [tree] if hasattr(tree, "numpy") else []


def damaged(text, lines):
    rows = text.splitlines(keepends=True)
    return {
        "a rating of 9": (
            rows[0] + lines[0].replace(",rule,3,", ",rule,9,"),
            "value is '9', not a whole number from 1 to 5",
        ),
        "an unknown clip": (rows[0] + "1,99999," + lines[0].split(",", 2)[2], "clip 99999 is not in"),
        "the same twice": (rows[0] + lines[0] + lines[0], "line 3: rating"),
        "no header": ("".join(rows[1:]), "has no column"),
        "not a number": (rows[0] + "x," + lines[0].split(",", 1)[1], "line 2: id is 'x', not a whole number"),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["a rating of 9", "an unknown clip", "the same twice", "no header", "not a number"]
)
def test_damaged_exports_get_one_sentence_and_leave_nothing_behind(study, tmp_path, fault, capsys):
    _, _, (ratings, segments, _) = study
    text = ratings.read_text()
    lines = [line for line in text.splitlines(keepends=True)[1:] if ",rule,3," in line]
    damage, sentence = damaged(text, lines)[fault]
    file = tmp_path / "bad.csv"
    file.write_text(damage)
    again = tmp_path / "again"
    assert main(["import", str(file), str(segments), "--data-dir", str(again)]) == 2
    assert sentence in capsys.readouterr().err
    with closing(Store(again)) as store:
        assert store.runs.all() == [] and store.ratings.last_event() == 0 and store.accounts.raters() == []
    assert main(["import", str(ratings), str(segments), "--data-dir", str(again)]) == 0


def test_what_is_not_an_export_or_not_empty_is_refused(study, tmp_path, capsys):
    _, data_dir, (ratings, segments, _) = study
    for pair, sentence in (
        ((ratings, ratings), "is not a file of segments"),
        ((ratings, tmp_path / "none"), "there is no file"),
        ((tmp_path / "none", segments), "there is no file"),
    ):
        assert main(["import", *map(str, pair), "--data-dir", str(tmp_path / "new")]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["import", str(ratings), str(segments), "--data-dir", str(data_dir)]) == 2
    assert "holds runs already" in capsys.readouterr().err


def test_the_card_says_what_there_is(study):
    _, data_dir, (_, _, file) = study
    text = file.read_text()
    for column in (*RATINGS, *SEGMENTS):
        assert f"| `{column}` |" in text
    assert "@Bob \\| co" in text and "left out of training" in text and "first" in text
    with closing(Store(data_dir)) as store:
        assert card(store, "first").count("\n") == text.count("\n")


def test_an_export_of_one_rater(study, capfdbinary):
    _, data_dir, _ = study
    assert main(["export", "--data-dir", str(data_dir), "--rater", "@Bob | co"]) == 0
    rows = list(csv.DictReader(capfdbinary.readouterr().out.decode().splitlines()))
    assert [(row["value"], row["repeat"], row["left_out"]) for row in rows] == [
        ("5", "0", "1"),
        ("4", "1", "1"),
    ]


def test_the_documentation_has_the_columns():
    text = (ROOT / "docs" / "data.md").read_text()
    for columns in (RATINGS, SEGMENTS, COMPARISONS, PAIRS, SKIPS, HISTORY):
        assert as_table(columns) in text
