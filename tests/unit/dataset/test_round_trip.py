"""Everything that people gave leaves and comes back; what was edited or made up on the way is refused."""

import csv
import io
import json
import re
import resource
import shutil
import sys
import zipfile
from contextlib import closing

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from aiohttp import web
from aiohttp.test_utils import TestClient, TestServer

from helpers import beside_playwright
from helpers.segments import noise
from helpers.small_disk import small_disk
from onedemo.app.cli.main import main
from onedemo.app.dataset.card import card
from onedemo.app.dataset.exporter import FILES
from onedemo.app.dataset.parquet import _opened
from onedemo.app.http.exports import Downloads
from onedemo.baselines.preferences import stored_comparisons
from onedemo.config import load_config, to_toml
from onedemo.demos.library import import_video
from onedemo.storage.clips import NewClip
from onedemo.storage.comparisons import NewPair
from onedemo.storage.store import Store
from unit.demos.test_library import make_video

EVENTS = (
    "SELECT e.*, p.name, b.name FROM events e JOIN raters p ON p.id = e.rater_id"
    " LEFT JOIN raters b ON b.id = e.by_id ORDER BY e.id"
)
ANSWERS = "SELECT c.*, p.name FROM comparisons c JOIN raters p ON p.id = c.rater_id ORDER BY c.id"
BY_ID = ("rater_id", "by_id")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Two runs with every kind of event there is; and their export."""
    directory = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(0)
    config = to_toml(load_config(None, {}))
    with closing(Store(directory / "data")) as store:
        for run in ("first", "second"):
            store.runs.add(run=run, demo="hop", demo_sha256="ab" * 32, seed=1, config=config, version="0.3.0",
                           step_seconds=0.01, created_at="2026-01-02T03:04:05.678Z")  # fmt: skip
        new = lambda: NewClip(  # noqa: E731
            demo_step=int(rng.integers(100)), segment=noise(rng, 5), stage="online", iteration=3, snapshot=2,
            predicted=float(rng.uniform(1, 5)), choice="high", score=0.1,
        )  # fmt: skip
        clips = [clip.id for run in ("first", "second") for clip in store.clips.add(run, [new()] * 6)]
        pairs = []
        for run in ("first", "second"):
            news = [
                NewPair(demo_step=k, left=noise(rng, 5), right=noise(rng, 5), stage="pretrain", iteration=0)
                for k in range(4)
            ]
            pairs += [pair.id for pair in store.comparisons.add_pairs(run, news)]
        ann = store.accounts.ensure("Ann", "annotator").id
        bob = store.accounts.ensure("007", "researcher").id
        rate, skip = store.ratings.rate, store.ratings.skip
        rate(clips[0], ann, 4, 900, mark=(1, 3))
        rate(clips[0], bob, 2, 800)
        store.ratings.undo(clips[0], bob)
        rate(clips[0], bob, 5, 700, mark=(0, 5))
        rate(clips[1], ann, 1, 600)
        rate(clips[1], ann, 2, 500, repeat=True)
        skip(clips[2], ann, 400)
        skip(clips[2], ann, 0, reason='=too dark, "or" so; ünd\u2028'.strip())
        skip(clips[3], bob, 300, reason="'-")
        skip(clips[4], bob, 200)
        store.ratings.undo(clips[4], bob)
        store.ratings.leave_out("first", ann, by=bob)
        store.ratings.leave_out("first", ann, by=bob, left_out=False)
        store.ratings.leave_out("second", ann, by=bob)
        rate(clips[7], ann, 3, 100)
        say = store.comparisons.compare
        say(pairs[0], ann, "left", 50)
        say(pairs[0], bob, "equal", 60)
        say(pairs[1], ann, "skip", 70)
        say(pairs[1], ann, "skip", 0, reason="=too short")
        say(pairs[2], ann, "right", 80)
        say(pairs[2], ann, "undo", 0)
        say(pairs[2], ann, "left", 90)
        say(pairs[5], bob, "right", 95)
    assert main(["export", "--data-dir", str(directory / "data"), "--all", str(directory / "export")]) == 0
    return directory / "data", directory / "export"


def test_everything_comes_back(study, tmp_path, capsys):
    data_dir, export = study
    assert sorted(path.name for path in export.iterdir()) == sorted(FILES)
    again = tmp_path / "again"
    assert main(["import", str(export), "--data-dir", str(again)]) == 0
    assert capsys.readouterr().out == "2 runs  6 clips  5 ratings  4 comparisons  23 events\n"
    with closing(Store(data_dir)) as before, closing(Store(again)) as after:
        for query in (EVENTS, ANSWERS):
            one, other = (by_name(store, query) for store in (before, after))
            assert one == other and len(one) > 5
        assert after.runs.all() == before.runs.all()
        roles = [{rater.name: rater.role for rater in store.accounts.raters()} for store in (before, after)]
        assert roles[0] == roles[1] == {"Ann": "annotator", "007": "researcher"}
        for run in ("first", "second"):
            assert after.ratings.tallies(run) == before.ratings.tallies(run)
            assert after.ratings.for_training(run) == before.ratings.for_training(run)
            # What `baseline preferences --from-run` learns from.
            for one, other in zip(*(stored_comparisons(s, run) for s in (before, after)), strict=True):
                assert one.preference == other.preference
                for a, b in zip(one.pair, other.pair, strict=True):
                    for name in ("obs", "actions", "qpos", "qvel"):
                        assert np.array_equal(getattr(a, name), getattr(b, name))
                        assert getattr(a, name).dtype == getattr(b, name).dtype
    # And what comes back leaves again as it came.
    assert main(["export", "--data-dir", str(again), "--all", str(tmp_path / "twice")]) == 0
    for name in set(FILES) - {"card.md"}:
        assert (tmp_path / "twice" / name).read_bytes() == (export / name).read_bytes(), name


def by_name(store, query):
    """Rows with people by name: their numbers may differ."""
    columns = [
        row[1] for row in store.database.rows(f"PRAGMA table_info({query.split('FROM ')[1].split()[0]})")
    ]
    return [
        tuple(value for column, value in zip([*columns, "p", "b"], row, strict=False) if column not in BY_ID)
        for row in store.database.rows(query)
    ]


def test_the_card_says_when_the_run_was_made_not_when_it_was_imported(study, tmp_path):
    _, export = study
    assert main(["import", str(export), "--data-dir", str(tmp_path)]) == 0
    with closing(Store(tmp_path)) as store:
        assert "made 2026-01-02T03:04:05.678Z" in card(store)


def test_one_run_leaves_alone(study, tmp_path):
    data_dir, _ = study
    arguments = ["export", "--data-dir", str(data_dir), "--run", "second", "--all", str(tmp_path / "one")]
    assert main(arguments) == 0
    assert main(["import", str(tmp_path / "one"), "--data-dir", str(tmp_path / "again")]) == 0
    with closing(Store(tmp_path / "again")) as store:
        assert [run["id"] for run in store.runs.all()] == ["second"]
        assert len(store.database.rows("SELECT 1 FROM comparisons")) == 1
        assert store.ratings.left_out("second")


def test_a_byte_order_mark_and_what_pandas_does_to_numbers_are_fine(study, tmp_path):
    _, export = study
    copy = shutil.copytree(export, tmp_path / "export")
    for name in ("ratings.csv", "history.csv"):
        (copy / name).write_bytes(b"\xef\xbb\xbf" + (copy / name).read_bytes())
    text = (copy / "ratings.csv").read_text()
    assert ",900,2," in text
    (copy / "ratings.csv").write_text(text.replace(",900,2,", ",900.0,2.0,"))
    assert main(["import", str(copy), "--data-dir", str(tmp_path / "again")]) == 0


def cell(column, value, name="ratings.csv", row=0):
    def edit(directory):
        rows = list(csv.reader((directory / name).read_text().splitlines()))
        rows[1 + row][rows[0].index(column)] = value
        out = io.StringIO()
        csv.writer(out).writerows(rows)
        (directory / name).write_text(out.getvalue())

    return edit


def text(change, name="ratings.csv"):
    def edit(directory):
        (directory / name).write_bytes(change((directory / name).read_bytes()))

    return edit


def table(change, name="segments.parquet"):
    """The first row of the Parquet file, changed."""

    def edit(directory):
        there = pq.read_table(directory / name)
        rows = there.to_pylist()
        rows[0] |= change(rows[0])
        pq.write_table(pa.Table.from_pylist(rows, there.schema), directory / name)

    return edit


def about(change):
    """The first run that the Parquet file describes, changed."""

    def edit(directory):
        file = directory / "segments.parquet"
        there = pq.read_table(file)
        key = b"onedemo.training.runs"
        runs = json.loads(there.schema.metadata[key])
        runs[0] |= change
        meta = there.schema.metadata | {key: json.dumps(runs).encode()}
        pq.write_table(there.replace_schema_metadata(meta), file)

    return edit


def bomb(directory):
    file = directory / "segments.parquet"
    there = pq.read_table(file)
    zeros = pa.ListArray.from_arrays([0, 9_000_000], pa.array(np.zeros(9_000_000)))
    column = there.column_names.index("qpos")
    rows = pa.ListArray.from_arrays([0, 1], zeros)
    row = there.slice(0, 1).set_column(column, there.schema.field("qpos"), rows)
    pq.write_table(row, file, compression="zstd")
    assert file.stat().st_size < 1 << 20


def varint(number, width=0):
    """As Parquet's metadata has whole numbers (Thrift's compact protocol), as long as one wants it."""
    left, out = 2 * number, bytearray()
    while left > 127 or len(out) + 1 < width:
        out.append(128 | left & 127)
        left >>= 7
    return bytes([*out, left])


def liar(directory):
    """The bomb, whose end says that it has a thousand numbers."""
    bomb(directory)
    file = directory / "segments.parquet"
    data = file.read_bytes()
    end = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    true = varint(9_000_000)
    assert true in data[end:]
    file.write_bytes(data[:end] + data[end:].replace(true, varint(1000, len(true))))


def talker(directory):
    """Says 20 MB of itself; what that is made into is not asked."""
    file = directory / "segments.parquet"
    there = pq.read_table(file)
    meta = there.schema.metadata | {b"more": bytes(20 << 20)}
    pq.write_table(there.replace_schema_metadata(meta), file)


EDITED = {
    "semicolons": (text(lambda b: b.replace(b",", b";")), "separated by ';': save it with commas"),
    "tabs": (text(lambda b: b.replace(b",", b"\t")), r"separated by '\\t'"),
    "another encoding": (text(lambda b: b.decode().encode("utf-16")), "not in UTF-8"),
    "a date as Excel writes it": (
        cell("created_at", "29/11/2026 01:11"),
        "line 2: created_at is '29/11/2026 01:11', not a time in UTC such as",
    ),
    "no date": (cell("created_at", ""), "line 2: created_at is '', not a time"),
    "a day that is none": (cell("created_at", "2026-02-31T01:02:03.000Z"), "not a time in UTC"),
    "less than no time": (cell("latency_ms", "-5"), "latency_ms is '-5', not a whole number from 0"),
    "a run that is not there": (cell("run", "other"), "belongs to run 'first', not 'other'"),
    "a run that is not there, left out": (
        lambda d: (cell("run", "other")(d), cell("left_out", "1")(d)), "belongs to run 'first', not 'other'",
    ),
    "the same row twice": (
        text(lambda b: b + b.splitlines(keepends=True)[1]), "is there twice, first in .*ratings.csv, line 2",
    ),
    "a rating of 9": (cell("value", "9"), "value is '9', not a whole number from 1 to 5"),
    "a rating of NaN": (cell("value", "nan"), "value is 'nan'"),
    "a prediction of NaN": (cell("predicted", "nan"), "predicted is 'nan', not a number"),
    "a mark that ends before it begins": (cell("mark_end", "0.001"), "a mark begins at mark_start"),
    "half a mark": (cell("mark_end", ""), "a mark begins at mark_start"),
    "a name that is none": (cell("rater", "A\u202enn"), "rater is .* not a name"),
    "no name": (cell("rater", ""), "rater is '', not a name"),
    "a cell more": (text(lambda b: b.rstrip() + b",x\r\n"), "line 6: it has more cells"),
    "cut off": (text(lambda b: b[:-30]), "fewer cells"),
    "a clip that is not there": (cell("clip_id", "99"), "clip 99 is not in"),
    "a pair that is not there": (cell("pair_id", "99", "comparisons.csv"), "pair 99 is not in"),
    "an answer that is none": (cell("answer", "both", "comparisons.csv"), "not one of left, right, equal"),
    "an event that is none": (cell("kind", "<b>", "history.csv"), "kind is '<b>', not one of"),
    "a pair that is rated": (
        lambda d: [
            cell(column, value, "history.csv")(d)
            for column, value in (("id", "50"), ("pair_id", "1"), ("clip_id", ""))
        ],
        "a pair is not for 'rate'",
    ),
    "motion that is not finite": (
        table(lambda row: {"qpos": [[float("nan")] * 6] * 5}), "qpos has numbers that are not finite",
    ),
    "motion too narrow": (table(lambda row: {"obs": [[0.0] * 10] * 5}), "obs is .5, 10., not .steps, 11."),
    "motion of no length": (table(lambda row: {"obs": []}), "not .steps, 11."),
    "motion of unequal length": (table(lambda row: {"obs": [[0.0] * 11] * 4}), "equal lengths"),
    "a pair of unequal length": (
        table(lambda row: {f"left_{n}": row[f"left_{n}"][:3] for n in ("obs", "actions", "qpos", "qvel")},
              "pairs.parquet"), "not of one length"),
    "a step of 10^12": (table(lambda row: {"demo_step": 10**12}), "demo_step is 1000000000000, not a whole"),
    "a clip of no stage": (table(lambda row: {"stage": "<script>"}), "stage is '<script>'"),
    "a clip for no reason": (table(lambda row: {"choice": "<script>"}), "choice is '<script>'"),
    "a clip of another run": (table(lambda row: {"run": "other"}), "run 'other', which the file does not"),
    "a clip without a number": (table(lambda row: {"clip_id": None}), "clip_id is None"),
    "two clips of one number": (table(lambda row: {"clip_id": 2}), "one number"),
    "Parquet with other bytes": (
        text(lambda b: b[:400] + bytes(300) + b[700:], "segments.parquet"), "segments.parquet is damaged",
    ),
    "Parquet that was cut off": (text(lambda b: b[:-100], "segments.parquet"), "is not a file of segments"),
    "Parquet of 72 MB in 20 KB": (bomb, "would unpack to .* numbers: no export of onedemo does"),
    "Parquet that says that it is small": (liar, "segments.parquet holds more than it says"),
    "Parquet that says much of itself": (talker, "says more of itself than any export"),
    "HTML as a demo": (about({"demo": "<img src=x onerror=alert(1)>"}), "a name is 1 to 64 letters"),
    "a run with a path": (about({"id": "../../../home/x/.cargo"}), "a name is 1 to 84 letters"),
    "HTML as a version": (about({"version": "<b>1"}), "version is not a version"),
    "a seed of 2^70": (about({"seed": 2**70}), "seed is out of range"),
    "settings that are none": (about({"config": "a = ="}), "does not say what its runs are"),
    "another robot": (about({"config": "env = 'dog'"}), "unknown robot 'dog'"),
    "a day that is none in a run": (about({"created_at": "yesterday"}), "a time in UTC"),
}  # fmt: skip


@pytest.mark.parametrize("what", EDITED)
def test_an_edited_export_gets_a_sentence_and_leaves_nothing_behind(study, tmp_path, what, capsys):
    edit, sentence = EDITED[what]
    copy = shutil.copytree(study[1], tmp_path / "export")
    edit(copy)
    assert main(["import", str(copy), "--data-dir", str(tmp_path / "again")]) == 2
    said = capsys.readouterr().err
    assert re.search(sentence, said) and said.count("\n") == 1, said
    with closing(Store(tmp_path / "again")) as store:
        assert store.runs.all() == [] and store.ratings.last_event() == 0 and not store.accounts.raters()
    assert not (tmp_path / "again" / "runs").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory is not limited")
def test_parquet_that_asks_for_memory_gets_none(study):
    """Whatever its end says, a page may unpack to anything; afterwards this process takes what it likes."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(MemoryError), _opened(study[1] / "segments.parquet"):
        pa.allocate_buffer(1 << 31)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    pa.allocate_buffer(1 << 31)


def test_a_browser_gets_everything_in_one_file(study, tmp_path):
    data_dir, export = study

    async def download() -> bytes:
        app = web.Application()
        app.router.add_get("/export.zip", Downloads(store, {}).everything)
        async with TestClient(TestServer(app)) as client:
            answer = await client.get("/export.zip")
            assert answer.status == 200 and "onedemo-everything-" in answer.headers["Content-Disposition"]
            return await answer.read()

    with closing(Store(data_dir)) as store:
        content = beside_playwright.run(download())
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path)
    (directory,) = tmp_path.iterdir()
    for name in set(FILES) - {"card.md"}:
        assert (directory / name).read_bytes() == (export / name).read_bytes()


def test_nothing_in_a_name_is_more_than_text_in_the_card(tmp_path):
    """Data of before names were checked, or of a program that writes into the database."""
    rng = np.random.default_rng(0)
    with closing(Store(tmp_path)) as store:
        store.runs.add(run="r", demo="<img src=x>", demo_sha256="<b>", seed=0, config="", version="[a](b)")
        (clip,) = store.clips.add(
            "r", [NewClip(demo_step=0, segment=noise(rng, 5), stage="online", iteration=0)]
        )
        rater = store.accounts.ensure("<script>|`x`", "annotator")
        store.ratings.rate(clip.id, rater.id, 3, 900)
        text = card(store)
    assert "<img" not in text and "<b>" not in text and "<script>" not in text and "[a](" not in text
    assert "&lt;script&gt;\\|\\`x\\`" in text


@pytest.mark.parametrize("option", ["--all", "--segments", "--pairs", "--card"])
def test_a_full_disk_is_a_sentence_and_leaves_no_half_file(study, tmp_path, option, capsys):
    with small_disk(tmp_path / "small", "4k") as place:
        arguments = ["export", "--data-dir", str(study[0]), option, str(place / "out")]
        assert main(arguments) == 2
        left = [path.name for path in place.rglob("*") if path.is_file()]
    said = capsys.readouterr().err
    assert "The disk is full: free some space" in said and said.count("\n") == 1, said
    assert set(left) <= {"history.csv"}  # whole ones of a whole export


@pytest.mark.seam
def test_a_demo_of_that_name_with_other_frames_is_named_before_anything_is_imported(tmp_path, capsys):
    there, here = tmp_path / "there", tmp_path / "here"
    video = make_video(tmp_path / "a.avi", count=40)
    rated = import_video(video, name="kick", demos_dir=there / "demos", speed=2.0, reverse=True)
    import_video(make_video(tmp_path / "b.avi", count=15), name="kick", demos_dir=here / "demos")
    config = to_toml(load_config(None, {}))
    with closing(Store(there)) as store:
        store.runs.add(run="r-1", demo="kick", demo_sha256=rated.sha256, seed=0, config=config, version="1",
                       title="With marks", note="Bo left at half.")  # fmt: skip
    assert main(["export", "--data-dir", str(there), "--all", str(tmp_path / "all")]) == 0
    assert main(["import", str(tmp_path / "all"), "--data-dir", str(here)]) == 2
    said = capsys.readouterr().err
    assert "rated beside a demo kick of 20 frames (2 times as fast, backwards), and the one" in said
    assert "has 15 and other pictures" in said
    card_text = (tmp_path / "all" / "card.md").read_text()
    assert "What was done to the video of the demonstration: 2 times as fast, backwards." in card_text
    assert not (here / "runs").exists()
    assert main(["demo", "rename", "kick", "kick-other", "--data-dir", str(here)]) == 0
    assert main(["import", str(tmp_path / "all"), "--data-dir", str(here)]) == 0
    with closing(Store(here)) as store:
        (run,) = store.runs.all()
    assert (run["title"], run["note"]) == ("With marks", "Bo left at half.")
