"""The quick form of the check that kills a server: what was given is there, once, after each death."""

import shutil

import pytest

from helpers import beside_playwright
from load import kill_server


@pytest.mark.seam
def test_ratings_survive_kills(tmp_path, looked):
    shutil.copytree(looked, tmp_path / "data")
    tally = beside_playwright.run(kill_server.check(tmp_path / "data", kills=3, seed=3, browser_share=0))
    assert (tally.lost, tally.doubled, tally.damaged, tally.notes) == (0, 0, 0, [])
    assert tally.kills == 3 and tally.given >= 2


def test_a_rating_that_is_lost_or_doubled_is_noticed(tmp_path):
    """The check itself: against a database that lacks one, and has one twice."""
    import sqlite3
    from contextlib import closing

    from onedemo.storage.store import Store

    with closing(Store(tmp_path)):
        pass
    ratings, tally = kill_server.Ratings(), kill_server.Tally()
    ratings.given.update([(1, 2), (2, 3)])
    ratings.open.update([(3, 4)])
    for kept, lost, doubled in (
        ([(1, 2), (2, 3)], 0, 0), ([(1, 2), (2, 3), (3, 4)], 0, 0), ([(1, 2)], 1, 0),
        ([(1, 2), (2, 3), (2, 3)], 0, 1), ([(1, 2), (2, 4)], 1, 1), ([(1, 2), (2, 3), (3, 4), (3, 4)], 0, 1),
    ):  # fmt: skip
        with closing(sqlite3.connect(tmp_path / "onedemo.sqlite3")) as db:
            db.executescript("DROP TABLE events; CREATE TABLE events (clip_id, value, kind)")
            db.executemany("INSERT INTO events VALUES (?, ?, 'rate')", kept)
            db.commit()
        kill_server.compare(tmp_path, tally, ratings)
        assert (tally.lost, tally.doubled) == (lost, doubled), kept
