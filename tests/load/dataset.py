"""What the page and the export cost when the database holds many ratings.

The database is filled by SQL in bulk, one transaction per size, with the product's own schema and
triggers: 50 raters, 500 iterations, every clip rated once, 20 clips that wait. Clips have segments only
where the training set is loaded, all with the same bytes; nothing else measured here reads one.
"""

from __future__ import annotations

import os
import re
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np

from onedemo.experiments.speed.figures import Growth, Result, single
from onedemo.reward.dataset import TrainingSet
from onedemo.storage.segment_codec import pack_segment
from onedemo.storage.store import Store
from onedemo.types import Segment

_RUN = "bench"
_RATERS, _ITERATIONS, _WAITING = 50, 500, 20
_MIB = 1024.0
_BLOCK = 1 << 20

_NUMBERS = "WITH RECURSIVE numbers (n) AS (SELECT ? UNION ALL SELECT n + 1 FROM numbers WHERE n < ?) "
_CLIPS = _NUMBERS + (
    "INSERT INTO clips (run, demo_step, steps, stage, iteration, snapshot, predicted, state, created_at)"
    f" SELECT '{_RUN}', n % 100, 38, iif(n > 200, 'online', 'pretrain'), n % {_ITERATIONS},"
    f" n % {_ITERATIONS}, 1 + n % 400 / 100.0, 'ready', '2025-01-01T00:00:00.000Z' FROM numbers"
)
_SEGMENTS = _NUMBERS + "INSERT INTO segments SELECT n, ? FROM numbers"
_EVENTS = _NUMBERS + (
    "INSERT INTO events (clip_id, rater_id, kind, value, snapshot, predicted, latency_ms, created_at)"
    f" SELECT n, 1 + n % {_RATERS}, 'rate', 1 + n * 7919 % 5, n % {_ITERATIONS}, 1 + n % 400 / 100.0,"
    " 600 + n % 3000, '2025-01-01T00:00:00.000Z' FROM numbers"
)


def measure(quick: bool) -> list[Result]:
    """Page and CSV with up to 1,000,000 ratings in the database (quick: 50,000), and loading for a refit."""
    return [*_page_and_csv(quick), _training_set(quick)]


def _page_and_csv(quick: bool) -> list[Result]:
    sizes = (1_000, 10_000, 50_000) if quick else (1_000, 10_000, 100_000, 1_000_000)
    turns = 3
    queries: list[list[float]] = []
    presses: list[list[float]] = []
    firsts: list[list[float]] = []
    peaks: list[list[float]] = []
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as directory:
        with closing(Store(Path(directory))) as store:
            _begin(store)
            known = 0
            for size in sizes:
                _fill(store.path, known, size)
                known = size
                queries.append([_seconds(_ask_all, store, size) for _ in range(5 * turns)])
                presses.append([_seconds(_press, store) for _ in range(5 * turns)])
                exports = [_export(Path(directory)) for _ in range(turns)]
                firsts.append([first for first, _ in exports])
                peaks.append([peak for _, peak in exports])
    most = f"{sizes[-1]:,} ratings"
    return [
        single(
            "csv_first_rows_s", f"onedemo export to its first rows, {most}", firsts[-1], unit="s", reach=1.0,
            how="from starting the command to its first block of 500 rows",
        ),
        single(
            "csv_peak_growth_mib", f"peak memory of onedemo export, {most} over {sizes[0]:,}",
            [most - least for least, most in zip(peaks[0], peaks[-1], strict=True)], unit="MiB",
            # The whole CSV is 91 bytes a rating; SQLite keeps 2 MiB of pages at most.
            reach=16.0, how="VmHWM of the process that writes the CSV, read while it writes",
        ),
        single(
            "page_queries_ms", f"all queries of opening the page and of one press, {most}",
            [1e3 * s for s in queries[-1]], unit="ms", reach=20.0,
            how="session, raters, iterations, tallies, classes, clips that wait, newest event; in one thread",
        ),
        Growth(
            name="data_growth", title="Page and CSV with many ratings", x_label="ratings in the database",
            y_label="s", x=list(sizes),
            y={
                "opening the page and one press: queries": _medians(queries),
                "a rating and its undo, committed": _medians(presses),
                "CSV: first rows": _medians(firsts),
            },
        ),
    ]  # fmt: skip


def _training_set(quick: bool) -> Growth:
    sizes = (100, 1_000, 5_000) if quick else (100, 1_000, 10_000, 100_000)
    rng = np.random.default_rng(0)
    segment = Segment(
        obs=rng.normal(size=(38, 11)),
        actions=rng.normal(size=(38, 3)).astype(np.float32),
        qpos=rng.normal(size=(38, 6)),
        qvel=rng.normal(size=(38, 6)),
    )
    whole, again = [], []
    with tempfile.TemporaryDirectory(prefix="onedemo-bench-") as directory:
        with closing(Store(Path(directory))) as store:
            _begin(store)
            known = 0
            for size in sizes:
                _fill(store.path, known, size, segment=pack_segment(segment))
                known = size
                training_set, event = TrainingSet(store, _RUN), store.ratings.last_event()
                assert len(training_set.at(event - 10)) == size - 10
                again.append(_seconds(training_set.at, event))
                whole.append(_seconds(TrainingSet(store, _RUN).at, event))
    return Growth(
        name="training_set_growth", title="Loading the ratings for a refit", x_label="ratings", y_label="s",
        x=list(sizes), y={"first refit of a process": whole, "next refit, 10 new ratings": again},
    )  # fmt: skip


def _begin(store: Store) -> None:
    """People and iterations, which do not grow with the ratings."""
    store.runs.add(run=_RUN, demo="backflip", demo_sha256="0", seed=0, config="", version="0")
    for number in range(_RATERS):
        store.accounts.ensure(f"rater {number}", "annotator")
    store.accounts.add_token("0" * 64, 1, "session")
    stats = dict.fromkeys(("predicted", "kl", "entropy", "value_loss", "steps_per_s", "true_reward"), 1.2345)
    for number in range(1, _ITERATIONS + 1):
        store.runs.add_iteration(_RUN, number, snapshot=number, env_steps=4096 * number, stats=stats)


def _fill(path: Path, known: int, ratings: int, *, segment: bytes | None = None) -> None:
    """Brings a database that holds ``known`` ratings of clips 1, 2, ... to more."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA synchronous = OFF")
        db.execute("BEGIN")
        first = known + _WAITING + 1 if known else 1  # clips that waited until now are rated, too
        db.execute(_CLIPS, (first, ratings + _WAITING))
        if segment is not None:
            db.execute(_SEGMENTS, (first, ratings + _WAITING, segment))
        db.execute(_EVENTS, (known + 1, ratings))
        db.execute("COMMIT")
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def _ask_all(store: Store, ratings: int) -> None:
    """What a page asks when it opens, tab by tab, and what it asks at a press."""
    store.accounts.rater_of("0" * 64, "session")
    store.accounts.raters()
    assert sum(store.ratings.by_class(_RUN)) == ratings  # Watch
    assert len(store.runs.iterations(_RUN)) == _ITERATIONS
    assert len(store.clips.waiting(_RUN)) == _WAITING  # Rate
    store.ratings.last_event()  # Data
    assert sum(map(sum, store.ratings.tallies(_RUN).values())) == ratings
    waiting = store.clips.waiting(_RUN)  # a press: the next clip, its picture, the count
    store.clips.get(waiting[0].id)
    store.ratings.by_class(_RUN)


def _press(store: Store) -> None:
    clip = store.clips.waiting(_RUN)[0].id
    store.ratings.rate(clip, 1, 3, latency_ms=900)
    store.ratings.undo(clip, 1)


def _export(directory: Path) -> tuple[float, float]:
    """Runs the command; seconds to its first rows, and the most memory it had, MiB."""
    command = [sys.executable, "-m", "onedemo.app.cli", "export", "--data-dir", str(directory)]
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        out = process.stdout.fileno()
        os.read(out, 4096)  # less than a block, so that it still writes when its memory is read
        first, peak = time.perf_counter() - began, _peak(process.pid)
        while os.read(out, _BLOCK):
            peak = max(peak, _peak(process.pid))
    if process.returncode:
        raise RuntimeError(f"onedemo export ended with exit code {process.returncode}")
    return first, peak


def _peak(process: int) -> float:
    """Most memory of a running process so far, MiB; 0 if it has just ended.

    Not ``ru_maxrss``: that of a child begins with what its parent had when it started it.
    """
    found = re.search(r"VmHWM:\s*(\d+) kB", Path(f"/proc/{process}/status").read_text())
    return int(found[1]) / _MIB if found else 0.0


def _seconds(work: Callable[..., object], *values: object) -> float:
    began = time.perf_counter()
    work(*values)
    return time.perf_counter() - began


def _medians(repetitions: list[list[float]]) -> list[float]:
    return [statistics.median(values) for values in repetitions]
