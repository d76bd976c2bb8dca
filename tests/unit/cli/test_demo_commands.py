"""``onedemo demo rename`` and ``remove``, beside runs that learn from a demo."""

from contextlib import closing

import pytest

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
