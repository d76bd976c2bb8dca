"""Studies: real processes that are resumed, fail, are killed and meet each other."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.paths import TESTS
from onedemo.app.cli.main import main
from onedemo.errors import UserError
from onedemo.experiments import registry, runner
from onedemo.experiments.registry import Entry, parse_seeds
from onedemo.experiments.runner import Job, Kind, peek, run_jobs
from onedemo.experiments.statistics import band, spread_of


def job(seed=0, kind="helpers.tiny_jobs:climb", label="climb", **settings):
    return Job(kind=kind, label=label, settings={"slope": 1.0, "steps": 5} | settings, seed=seed)


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


# What a result belongs to


def test_the_key_is_stable_and_does_not_know_the_label():
    first = job(kind="tiny:climb", a={"b": [1, 2], "c": None})
    assert first.key == "518219699e01268e9667d7b7cd36f177b9812de087ff94c6be87fa9dfad8bd3e"
    shuffled = Job(
        kind="tiny:climb", label="other", seed=0,
        settings={"a": {"c": None, "b": (1, 2)}, "steps": 5, "slope": 1.0},
    )  # fmt: skip
    assert shuffled.key == first.key
    others = [
        job(1, a={"b": [1, 2], "c": None}),
        job(a={"b": [2, 1], "c": None}),
        job(kind="helpers.tiny_jobs:falls"),
    ]
    assert len({first.key, *(other.key for other in others)}) == 4


def test_a_new_version_of_a_method_is_another_key(monkeypatch):
    before = Job(kind="method", label="x", settings={}, seed=0).key
    monkeypatch.setitem(runner.KINDS, "method", replace(runner.KINDS["method"], version=99))
    assert Job(kind="method", label="x", settings={}, seed=0).key != before


def test_jobs_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="unknown kind of job 'methot'; there are: method, "):
        job(kind="methot")
    with pytest.raises(ValueError, match=r"settings of job 'climb': .*ndarray"):
        job(a=np.zeros(2))
    with pytest.raises(ValueError, match="settings of job 'climb'"):
        job(a=float("nan"))


# Running


@pytest.mark.seam
def test_finished_runs_are_not_run_again(tmp_path):
    log = tmp_path / "log"
    jobs = [job(seed, log=str(log)) for seed in (0, 1)]
    results = tmp_path / "results"
    assert [outcome.state for outcome in peek(jobs, results)] == ["not run", "not run"]
    told = []
    first = run_jobs(jobs, results, workers=2, tell=told.append)
    assert [outcome.result["height"] for outcome in first] == [4, 5]
    assert first[0].result["curve"]["nothing"] == [None] * 3
    assert first[0].result["threads"] == "1"
    assert sorted(log.read_text().split()) == ["0", "1"]
    assert "climb, seed 0: started" in told and told[-1].endswith("(2 of 2)")

    # Other labels, one more seed: only that seed is run.
    again = [job(seed, label="in another table", log=str(log)) for seed in (0, 1, 2)]
    second = run_jobs(again, results)
    assert [outcome.result["height"] for outcome in second] == [4, 5, 6]
    assert [outcome.job.label for outcome in second] == ["in another table"] * 3
    assert sorted(log.read_text().split()) == ["0", "1", "2"]
    assert [outcome.state for outcome in peek(again, results)] == ["done"] * 3

    files = sorted(file.name for file in (results / "helpers.tiny_jobs_climb").iterdir())
    assert files == sorted(
        [f"climb-s{o.job.seed}-{o.job.key[:10]}.json" for o in first]
        + [f"in_another_table-s2-{again[2].key[:10]}.json"]
    )  # and no scratch directory, no lock
    kept = json.loads((results / "helpers.tiny_jobs_climb" / files[0]).read_text())
    assert kept["settings"] == jobs[0].settings and kept["wall_s"] >= 0 and len(kept["load_average"]) == 3
    assert kept["machine"]["packages"]["numpy"] == np.__version__
    assert {"version", "commit", "date", "method_version", "seed", "cpu_s"} <= kept.keys()


@pytest.mark.seam
def test_jobs_share_a_cache_if_they_ask_for_one(tmp_path):
    jobs = [job(seed, kind="helpers.tiny_jobs:remembers") for seed in (0, 1)]
    run_jobs(jobs[:1], tmp_path)
    second = run_jobs(jobs, tmp_path)[1]
    assert second.result == {"there": ["0", "1"]}
    assert (tmp_path / "cache" / "1").exists()
    assert "cache" not in second.kept


@pytest.mark.seam
def test_a_run_that_fails_or_dies_is_told_and_not_kept(tmp_path):
    jobs = [
        job(1, kind="helpers.tiny_jobs:falls"),
        job(0, kind="helpers.tiny_jobs:dies"),
        job(2, kind="helpers.tiny_jobs:falls"),
    ]
    told = []
    fell, died, well = run_jobs(jobs, tmp_path, tell=told.append)
    assert fell.failed and fell.result is None and "Traceback" not in fell.state
    assert fell.state == "failed: RuntimeError: fell at step 1"
    assert "about to fall" in fell.reason or "in falls" in fell.reason
    assert died.state == "failed: the process was ended by SIGKILL, perhaps for want of memory"
    assert well.result == {"height": 0} and not well.failed
    assert [outcome.state for outcome in peek(jobs, tmp_path)] == ["not run", "not run", "done"]
    assert any("fell at step 1" in line for line in told)


@pytest.mark.seam
def test_the_same_job_twice_is_run_once(tmp_path):
    log = tmp_path / "log"
    twice = [job(label="a", log=str(log)), job(label="b", log=str(log))]
    outcomes = run_jobs(twice, tmp_path / "results", workers=2)
    assert [outcome.job.label for outcome in outcomes] == ["a", "b"]
    assert outcomes[0].result == outcomes[1].result and log.read_text() == "0\n"


@pytest.mark.seam
def test_two_studies_at_once_share_the_work(tmp_path):
    log = tmp_path / "log"
    jobs = [job(seed, kind="helpers.tiny_jobs:naps", log=str(log)) for seed in (0, 1)]
    both = [None, None]

    def run(index):
        both[index] = run_jobs(jobs, tmp_path / "results", workers=1)

    threads = [threading.Thread(target=run, args=(index,)) for index in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(outcome.result == {} for outcomes in both for outcome in outcomes)
    assert log.read_text().split().count("begin") == 2


def test_the_lock_of_a_study_that_has_gone_does_not_block(tmp_path):
    stale = tmp_path / "helpers.tiny_jobs_climb" / f".{job().key[:10]}.lock"
    stale.parent.mkdir()
    stale.write_text("")
    assert run_jobs([job()], tmp_path)[0].result["height"] == 4


def test_a_file_that_is_no_result_is_named(tmp_path):
    file = tmp_path / "helpers.tiny_jobs_climb" / f"x-s0-{job().key[:10]}.json"
    file.parent.mkdir()
    file.write_text("{}")
    with pytest.raises(UserError, match=f"{file} is not the result of a run"):
        peek([job()], tmp_path)


def test_a_file_of_other_settings_is_not_taken(tmp_path):
    file = tmp_path / "helpers.tiny_jobs_climb" / f"x-s0-{job().key[:10]}.json"
    file.parent.mkdir()
    file.write_text(json.dumps(job(slope=9).description | {"result": {}}))
    assert peek([job()], tmp_path)[0].state == "not run"


_PARENT = """
import signal
import sys
from pathlib import Path
from onedemo.experiments.runner import Job, run_jobs
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
at, results = sys.argv[1:]
jobs = [Job(kind="helpers.tiny_jobs:waits", label="wait", settings={"at": at}, seed=seed) for seed in (0, 1)]
run_jobs(jobs, Path(results), workers=2)
"""


@pytest.mark.seam
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_of_a_study_that_is_ended(tmp_path, end):
    results = tmp_path / "results"
    parent = subprocess.Popen(
        [sys.executable, "-c", _PARENT, str(tmp_path), str(results)],
        env=os.environ | {"PYTHONPATH": str(TESTS)},
        stderr=subprocess.DEVNULL,
    )
    files = [tmp_path / f"{seed}.pids" for seed in (0, 1)]
    until(lambda: all(file.exists() for file in files))
    words = [file.read_text().split(maxsplit=2) for file in files]
    pids = [int(word) for each in words for word in each[:2]]
    assert all(alive(pid) for pid in pids) and all(Path(each[2]).is_dir() for each in words)
    parent.send_signal(end)
    assert parent.wait(20) != 0
    until(lambda: not any(alive(pid) for pid in pids))
    assert not any(Path(each[2]).exists() for each in words)
    assert not list(results.rglob("*.json"))


# Statistics


def test_spread_counts_what_is_missing():
    figures = spread_of([1.0, None, 4.0])
    assert (figures.mean, figures.low, figures.high, figures.missing) == (2.5, 1, 4, 1)
    assert figures.deviation == pytest.approx(4.5**0.5)  # (1.5² + 1.5²) / (2 - 1)
    assert str(figures) == "2.5 ± 2.12 (2 of 3 seeds)" and figures.each == "1, –, 4"
    assert figures.count(1.0) == 2 and figures.count(2) == 1
    assert str(spread_of([None, None])) == "not run"
    assert str(spread_of([3.0])) == "3"


def test_band_is_over_the_range_that_all_seeds_have():
    curves = [([0, 10, 20], [0.0, 1.0, 2.0]), ([5, 25], [1.0, 3.0]), ([0, 15, 30], [0.0, None, 3.0])]
    over = band(curves, points=4)
    assert over.x.tolist() == [5, 10, 15, 20]
    assert over.lines.round(9).tolist() == [[0.5, 1, 1.5, 2], [1, 1.5, 2, 2.5], [0.5, 1, 1.5, 2]]
    line = over.line("x")
    assert line.low.tolist() == [0.5, 1, 1.5, 2] and line.high.tolist() == [1, 1.5, 2, 2.5]
    assert line.y == pytest.approx([2 / 3, 3.5 / 3, 5 / 3, 6.5 / 3])
    with pytest.raises(ValueError, match="no points in one of 1 curves"):
        band([([0], [None])])
    with pytest.raises(ValueError, match="one begins at 2, one ends at 1"):
        band([([0, 1], [0, 1]), ([2, 3], [0, 1])])


def test_seeds_as_typed():
    assert parse_seeds("3") == (0, 1, 2) and parse_seeds("3,7,9") == (3, 7, 9) and parse_seeds("7,") == (7,)
    for wrong in ("0", "-1", "", ",", "3,3", "x", "1,-2"):
        with pytest.raises(ValueError):
            parse_seeds(wrong)


# The command


@pytest.fixture
def tiny_table(monkeypatch, tmp_path):
    monkeypatch.setitem(registry.TABLES, "tiny", Entry("helpers.tiny_jobs", "a tiny table"))
    monkeypatch.setattr(sys, "argv", ["onedemo", "bench", "tiny"])
    monkeypatch.chdir(tmp_path)


def test_every_table_has_its_help(capsys):
    for name in registry.TABLES:
        assert main(["bench", name, "--help"]) == 0
        assert "settings were tuned on seeds from 100 on" in " ".join(capsys.readouterr().out.split())


def test_report_of_what_there_is(tiny_table, capsys):
    assert main(["bench", "tiny", "--report-only"]) == 0
    text = capsys.readouterr().out
    assert text.count("seed 0 not run; seed 1 not run; seed 2 not run") == 2
    assert not Path("bench-results").exists()


@pytest.mark.seam
def test_a_table_from_command_to_report(tiny_table, capsys):
    pytest.importorskip("matplotlib")
    command = "bench tiny --quick --seeds 0,1 --out report --json all.json --results kept --workers 2"
    assert main(command.split()) == 0
    printed = capsys.readouterr()
    assert "9.5 ± 0.707" in printed.out and "4 of 4" in printed.err
    about = json.loads(Path("all.json").read_text())
    assert about["method_versions"] == {"helpers.tiny_jobs:climb": 1}
    assert [run["result"]["height"] for run in about["runs"]] == [18, 19, 9, 10]
    assert all("curve" not in run["result"] for run in about["runs"])
    text = Path("report/report.md").read_text()
    assert "`onedemo bench tiny`" in text and "The quick form" in text and about["date"][:10] in text
    assert "| whole | 0, 1 | 2 of 2 |" in text
    assert {"heights.svg", "report.md"} <= {file.name for file in Path("report").iterdir()}

    # Partial: one seed more, not run.
    assert main("bench tiny --quick --seeds 3 --results kept --report-only".split()) == 0
    assert "18.5 ± 0.707 (2 of 3 seeds)" in capsys.readouterr().out


@pytest.mark.seam
def test_a_run_that_failed_fails_the_command(tiny_table, monkeypatch, capsys):
    from helpers import tiny_jobs

    failing = [job(1, kind="helpers.tiny_jobs:falls", label="fall")]
    table = replace(tiny_jobs.TABLE, plan=lambda seeds, quick: failing, parts=[])
    monkeypatch.setattr(tiny_jobs, "TABLE", table)
    assert main(["bench", "tiny"]) == 1
    assert "seed 1 failed: RuntimeError: fell at step 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--seeds 0", "must be how many seeds, or a list of different ones such as 3,7,9; got '0'"),
        ("--seeds x", "must be how many seeds, or a list"),
        ("--workers 0", "must be a whole number of at least 1, got '0'"),
        ("--results file", "--results file is a file"),
        ("--out file", "--out file is a file"),
        ("--out file/report", "is not a directory that can be written to"),
        ("--json .", ". is a directory"),
    ],
)
def test_bad_options_before_any_work(options, sentence, tiny_table, capsys):
    Path("file").write_text("")
    assert main(["bench", "tiny", *options.split()]) == 2
    assert sentence in capsys.readouterr().err and not Path("bench-results").exists()


def test_tuning_seeds_are_told_apart(tiny_table, capsys):
    assert main("bench tiny --report-only --seeds 100,".split()) == 0
    assert "Not for reporting" in capsys.readouterr().out


def test_kinds_name_functions():
    for kind in runner.KINDS.values():
        assert isinstance(kind, Kind) and kind.function.count(":") == 1 and kind.version >= 1
