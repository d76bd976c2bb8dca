"""``onedemo demo``: edits of a video; ``rename`` and ``remove``, beside runs that learn from a demo."""

import re
from contextlib import closing

import pytest
from data.videos import numbered
from PIL import Image

from onedemo.app.cli.main import main
from onedemo.demos.library import find_demo, import_video
from onedemo.storage.store import Store
from unit.demos.test_library import make_video

pytestmark = pytest.mark.seam


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return make_video(tmp_path_factory.mktemp("video") / "move.avi", count=12)


def with_a_run(directory, demo):
    with closing(Store(directory)) as store:
        store.runs.add(run="r-1", demo=demo.name, demo_sha256=demo.sha256, seed=0, config="", version="1")


def test_a_demo_that_a_run_learns_from_is_renamed_and_not_removed(video, tmp_path, capsys):
    place = ["--data-dir", str(tmp_path)]
    demo = import_video(video, name="kick", demos_dir=tmp_path / "demos")
    with_a_run(tmp_path, demo)
    assert main(["demo", "remove", "kick", *place]) == 2
    said = capsys.readouterr().err
    assert "run r-1 learns from" in said and "onedemo demo rename kick NEW" in said
    assert main(["demo", "rename", "kick", "wrong-crop", *place]) == 0
    assert find_demo("wrong-crop", tmp_path / "demos").sha256 == demo.sha256
    with closing(Store(tmp_path)) as store:
        assert [run["demo"] for run in store.runs.all()] == ["wrong-crop"]
    again = import_video(video, name="kick", demos_dir=tmp_path / "demos", crop=(0, 40, 80, 48))
    assert main(["demo", "remove", "kick", *place]) == 0  # no run learns from this one
    assert not again.path.parent.exists() and demo.path.exists()


def test_without_a_database_a_demo_is_removed(video, tmp_path):
    demo = import_video(video, name="kick", demos_dir=tmp_path / "demos")
    assert main(["demo", "remove", "kick", "--data-dir", str(tmp_path)]) == 0
    assert not demo.path.parent.exists() and not list(tmp_path.glob("onedemo.sqlite3"))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A GIF with one picture a control step of 0.008 s, played at 3 hundredths of a second each."""
    path = tmp_path_factory.mktemp("video") / "walker.gif"
    images = [Image.fromarray(numbered(number, 160, 120)) for number in range(125)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=30)
    return str(path)


def test_what_is_done_to_a_video_is_said_and_shown(simulated, tmp_path, capsys):
    place = ["--data-dir", str(tmp_path)]
    add = ["demo", "add", simulated, *place, "--name"]
    assert main([*add, "run", "--speed", "3.75", "--reverse", "--loop", "--rotate", "90"]) == 0
    out, err = capsys.readouterr()
    done = "turned by 90°, 3.75 times as fast, backwards, repeated to fill 8 s"
    assert out.startswith(f"run: 8.0 s, 240 frames, 120x160\ndone to the video: {done}\n")
    assert err == "" and list_line(place, capsys, "run").endswith(f"walker.gif ({done})")
    assert main(["demo", "show", "run", *place]) == 0
    assert f"edits   {done}\n" in capsys.readouterr().out
    assert main([*add, "plain", "--loop", "2", "--start", "0.3", "--end=1.3", "--crop", "0,0,120,60"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(
        "plain: 2.0 s, 60 frames, 120x60\ndone to the video: from 0.3 to 1.3 s, cropped, repeated 2"
    )
    assert err == "onedemo: the picture is only 120 x 60 pixels; details will be hard to see\n"
    assert main([*add, "whole", "--loop", "1"]) == 0
    assert "done to the video:" not in capsys.readouterr().out
    assert list_line(place, capsys, "whole").endswith("walker.gif")


def list_line(place, capsys, name):
    assert main(["demo", "list", *place]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(name)]
    return line


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--speed", "fast"], "--speed must be a number from 0.1 to 20, .* got fast"),
        (["--speed", "0"], "--speed must be a number from 0.1 to 20, .* got 0"),
        (["--speed", "-1"], "--speed must be a number from 0.1 to 20, .* got -1"),
        (["--loop", "0"], "--loop must be a whole number, 1 or more, or stand alone .* 8 s, got 0"),
        (["--loop", "99"], "--loop 99 of 3.73 s is 370 s.* --loop 16 is the most here"),
        (["--rotate", "45"], "--rotate must be 90, 180 or 270 degrees clockwise, got 45"),
        (["--stabilise"], "--stabilise finds no background in .*walker.gif at 0.0. s"),
    ],
)
def test_bad_options_are_one_sentence_with_what_would_be_right(simulated, tmp_path, capsys, words, said):
    assert main(["demo", "add", simulated, "--name", "x", "--data-dir", str(tmp_path), *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and re.fullmatch(f"onedemo: {said}.*\n", err), err
    assert not [path for path in (tmp_path / "demos").glob("*")]
