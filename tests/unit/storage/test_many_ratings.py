"""What does not grow with the ratings: counted in SQLite's own steps and in bytes, not in seconds."""

import itertools
import tracemalloc

import pytest

from load.dataset import _RUN, _ask_all, _begin, _fill, _press
from onedemo.app.annotation.agreement import quality, quality_by_rater, rating_rows
from onedemo.app.dataset.csv_writer import csv_blocks
from onedemo.app.tabs.data import data_html
from onedemo.storage.rating_records import RATING_COLUMNS
from onedemo.storage.store import Store


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    _begin(store)
    yield store
    store.close()


def steps_of(store, work, *values):
    """Instructions that SQLite's virtual machine executes for a piece of work."""
    count = itertools.count()
    connections = (store.database._db, store.database._reader)
    for db in connections:
        db.set_progress_handler(lambda: next(count) and None, 1)
    try:
        work(*values)
    finally:
        for db in connections:
            db.set_progress_handler(None, 0)
    return next(count)


def test_the_page_and_a_press_cost_the_same_with_forty_times_the_ratings(store):
    _fill(store.path, 0, 500)
    before = steps_of(store, _ask_all, store, 500), steps_of(store, _press, store)
    _fill(store.path, 500, 20_000)
    after = steps_of(store, _ask_all, store, 20_000), steps_of(store, _press, store)
    assert min(before) > 100
    for small, large in zip(before, after, strict=True):
        assert large < 1.2 * small
    # The measure itself: what walks the ratings does grow.
    assert steps_of(store, store.database.rows, "SELECT COUNT(*) FROM ratings") > 20_000


def test_what_an_open_page_asks_twice_a_second_costs_little_in_another_run_too(store):
    """A rater who has rated much in one run has nothing to take back in the next, after a short look."""

    def ask():
        assert store.ratings.last_answer("next", 1) is None
        assert store.comparisons.last_compared("next", 1) is None
        assert store.ratings.count_for_training("next") == 0

    store.runs.add(run="next", demo="d", demo_sha256="0", seed=0, config="", version="0")
    _fill(store.path, 0, 50 * 450)
    small = steps_of(store, ask)
    _fill(store.path, 50 * 450, 50 * 1_800)
    assert steps_of(store, ask) < 1.2 * small
    assert store.ratings.last_answer(_RUN, 1) is not None


def test_a_csv_takes_no_memory_that_grows_with_it(store):
    def peak_and_length():
        tracemalloc.start()
        try:
            length = sum(len(block) for block in csv_blocks(store.ratings.stream()))
            return tracemalloc.get_traced_memory()[1], length
        finally:
            tracemalloc.stop()

    _fill(store.path, 0, 2_000)
    peak_and_length()  # what is loaded once
    small, short = peak_and_length()
    _fill(store.path, 2_000, 20_000)
    large, long = peak_and_length()
    assert long > 9 * short
    assert large < 1.2 * small


def test_the_first_block_of_a_csv_waits_for_no_more_rows_than_it_holds():
    taken = itertools.count()
    rows = ((next(taken), *("x",) * 13) for _ in itertools.count())  # no end
    block = next(csv_blocks(rows, rows_per_block=10))
    assert block.count(b"\r\n") == 11 and next(taken) == 10


def test_no_ratings_are_a_header():
    assert b"".join(csv_blocks([])) == ",".join(RATING_COLUMNS).encode() + b"\r\n"


def test_the_data_tab_shows_the_tallies(store):
    _fill(store.path, 0, 500)
    rows = rating_rows(store, _RUN)
    people = {rater.name: rater for rater in store.accounts.raters()}
    names = {rater.id: name for name, rater in people.items()}
    given = {names[rater]: counts for rater, counts in store.ratings.counts(_RUN).items()}
    html = data_html(
        _RUN, "onedemo", store.ratings.tallies(_RUN), quality(rows), quality_by_rater(rows), given, people,
        set(), {}, [], [],
    )  # fmt: skip
    assert "500 given: 500 used for training" in html
    row = '<th scope="row">rater 3</th><td class="od-text">before practice</td>'
    cells = store.ratings.tallies(_RUN)["rater 3", "pretrain"]
    assert row + "".join(f"<td>{cell or '·'}</td>" for cell in cells) + f"<td><b>{sum(cells)}</b>" in html
    assert sum(cells) == 4
