"""Where results are to be written is tried before the work, by every command that writes any."""

import pytest

from helpers.small_disk import small_disk
from onedemo.app.cli.main import main
from onedemo.core.outputs import check_data_dir, check_outputs, check_prefix
from onedemo.errors import UserError


@pytest.fixture
def here(tmp_path, monkeypatch):
    """In a directory with a file called ``file`` and a data directory."""
    from onedemo.storage.store import Store

    Store(tmp_path / "data").close()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "baseline trpo --out {}", "baseline preferences --out {}", "train --json {}", "backup {}",
        "audit --csv {}", "bench speed --json {}", "bench speed --out {}", "bench backflip --results {}",
        "export --out {}", "export --segments {}", "export --comparisons {}", "export --skips {}",
        "export --card {}",
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["file/x", "nowhere/near/x"])
def test_a_result_that_cannot_be_written_is_told_before_any_work(command, place, here, capsys):
    assert main(command.format(place).split()) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"onedemo: cannot write {place}") and "is not a directory that can be" in said
    assert sorted(path.name for path in here.iterdir()) == ["data", "file"]
    assert (here / "file").read_text() == "mine"


def test_a_demo_is_not_decoded_where_it_cannot_be_kept(here, capsys):
    assert main("demo add file --name x --data-dir file/data".split()) == 2
    assert "cannot write file/data/demos" in capsys.readouterr().err


def test_what_can_be_written_leaves_nothing_behind(here):
    check_outputs(here / "a", None, directories={"--out": here / "new", "--more": None})
    check_prefix(here / "b", (".json", ".pt"))
    check_data_dir(here / "c" / "d")
    assert sorted(path.name for path in here.iterdir()) == ["data", "file"]
    with pytest.raises(UserError, match="--out file is a file"):
        check_outputs(directories={"--out": (here / "file").relative_to(here)})
    with pytest.raises(UserError, match="file name too long"):
        check_outputs(here / ("x" * 300))


def test_a_disk_without_a_block_left(here):
    with small_disk(here / "small", "8k") as place:
        (place / "ballast").write_bytes(bytes(8192))
        with pytest.raises(UserError, match="no space left"):
            check_outputs(place / "result")
