"""What the Runs tab says of runs, without a browser."""

import re

import pytest

from onedemo.app.services.run_manager import OFFERED
from onedemo.app.tabs.runs import chosen_runs, fields_of, runs_html, settings_of
from onedemo.config import describe, load_config, to_toml
from onedemo.storage.rating_counts import Counts
from onedemo.types import Status


def run(name, **changes):
    about = {"id": name, "demo": "hop", "demo_sha256": "0", "seed": 3, "config": "", "title": "", "note": ""}
    return about | changes


def lines(runs, figures=None, status=None, current="here"):
    figures = {
        each["id"]: {"ratings": Counts(), "comparisons": 0} | (figures or {}).get(each["id"], {})
        for each in runs
    }
    status = status or Status(phase="online", message="")
    html = str(runs_html(runs, figures, current, status, [current]))
    rows = re.findall(r"<tr role=\"row\" data-run.*?</tr>", html, re.DOTALL)
    return {re.search('data-run="([^"]+)"', row)[1]: re.sub(r"\s+", " ", row) for row in rows}


def test_the_state_of_each_run_in_words():
    done = to_toml(load_config(None, {"rollouts.total_steps": 16_000}))
    runs = [run("old"), run("new"), run("done", config=done), run("here")]
    figures = {"old": {"ratings": Counts(classes=(1,) * 5)}, "done": {"env_steps": 16_000, "number": 1}}
    shown = lines(runs, figures)
    assert list(shown) == ["here", "done", "new", "old"]  # the one at hand, then the newest first
    states = {name: re.search("<b data-state[^>]*>([^<]+)", row)[1] for name, row in shown.items()}
    assert states == {"here": "Practising", "done": "Done", "new": "Not begun", "old": "Stopped"}
    assert "Pause" in shown["here"] and "Open" in shown["old"]
    assert "16 k <small>of 16 k" in shown["done"] and "0 <small>of 10.00 M" in shown["new"]
    failed = lines(runs, status=Status(phase="failed", message="", error="The disk is full."))["here"]
    assert "Failed" in failed and "The disk is full." in failed and "Try again" in failed


def test_what_people_write_is_text():
    row = lines([run("here", title="<b>x</b>", note='"><script>')])["here"]
    assert "&lt;b&gt;x&lt;/b&gt;" in row and "<script>" not in row and 'data-note="&#34;&gt;' in row


def test_any_runs_are_compared():
    runs = [f"r-{k}" for k in range(20)]
    newest = ["r-19", "r-18", "r-17", "r-16", "r-15", "r-3"]
    assert chosen_runs(runs, "", "r-3") == (newest, 0)
    assert chosen_runs(runs, "r-0, r-7,gone", "r-3") == (["r-7", "r-0"], 0)
    assert chosen_runs(runs, ",", "r-3") == ([], 0)
    assert chosen_runs(runs, ",".join(runs), "r-3") == ([f"r-{k}" for k in range(19, 7, -1)], 8)


def test_the_form_says_what_the_settings_say():
    said = {key: meaning for key, _, meaning in describe()}
    fields = {field["key"]: field for field in fields_of(to_toml(load_config(None, {"ratings.pretrain": 7})))}
    assert {*fields, "env", "ratings.choice"} == set(OFFERED)
    for key, field in fields.items():
        assert field["said"] == said[key] and field["wrong"].startswith("This is a ")
    assert (fields["ratings.pretrain"]["value"], fields["ratings.pretrain"]["usual"]) == (7, "200")


@pytest.mark.parametrize(
    ("config", "method", "steps"),
    [
        ("", "onedemo", 10_000_000),
        ("seed = 1\n", "paper", 10_000_000),  # a legacy run
        ('method = "onedemo"\n[rollouts]\ntotal_steps = 5\n', "onedemo", 5),
        ('method = 3\nrollouts = "x"\n', "paper", 10_000_000),
        ("not TOML", "paper", 10_000_000),
    ],
)
def test_settings_of_any_run_are_read(config, method, steps):
    found = settings_of(config)
    assert (found["method"], found["rollouts.total_steps"]) == (method, steps)
