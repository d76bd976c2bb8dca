"""Installations that cannot work are named in a sentence, by the command that fails and by the doctor."""

import os
import subprocess
import sys
import sysconfig

import pytest

from helpers.paths import ROOT
from onedemo.app.admin import environment
from onedemo.app.cli.main import main


@pytest.mark.parametrize("command", [["rater", "list"], ["doctor"]])
@pytest.mark.parametrize(
    ("what", "value", "words"),
    [
        ("platform", "win32", "onedemo does not run on Windows itself"),
        ("version_info", (3, 10, 2, "final", 0), "onedemo needs Python 3.11 or newer, and this is 3.10.2"),
    ],
)
def test_systems_that_cannot_run_it(command, what, value, words, monkeypatch, capsys):
    monkeypatch.setattr(sys, what, value)
    code = main(command)
    monkeypatch.undo()
    said = capsys.readouterr().err
    assert code == 2 and said.startswith(f"onedemo: {words}") and said.count("\n") == 1


def test_this_installation_is_sound_and_one_on_alpine_is_not(monkeypatch):
    assert environment.faults() == []
    monkeypatch.setattr(sysconfig, "get_config_var", lambda name: "cpython-313-x86_64-linux-musl")
    (said,) = environment.faults()
    assert "musl (Alpine)" in said


@pytest.mark.parametrize(
    ("module", "installed", "code", "words"),
    [
        (
            "cv2",
            {"opencv-python": "4.12.0"},
            "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')",
            "opencv-python took the place of opencv-python-headless, and cannot be loaded here (libGL.so.1",
        ),
        (
            "mujoco",
            {"mujoco": "2.3.0"},
            "raise AttributeError('module mujoco has no attribute rollout')",
            "mujoco is 2.3.0, <",
        ),
    ],
)
def test_packages_that_do_not_work(module, installed, code, words, tmp_path):
    (tmp_path / module).mkdir()
    (tmp_path / module / "__init__.py").write_text(code)
    for name, version in installed.items():
        about = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))

    def run(*command):
        return subprocess.run(
            [sys.executable, "-m", "onedemo.app.cli", *command, "--data-dir", str(tmp_path / "data")],
            env=os.environ | {"PYTHONPATH": path}, cwd=ROOT, capture_output=True, text=True, timeout=120,
        )  # fmt: skip

    ended = run("train", "--steps", "1")
    assert ended.returncode == 2 and ended.stderr.startswith(f"onedemo: {words}"), ended.stderr
    assert ended.stderr.count("\n") == 1
    ended = run("doctor")
    assert ended.returncode == 1 and f"BAD  installation     {words}" in ended.stdout, ended.stderr
    assert "Traceback" not in ended.stderr


def test_an_ascii_terminal_gets_names_with_numbers(tmp_path):
    def run(*command):
        return subprocess.run(
            [sys.executable, "-m", "onedemo.app.cli", *command, "--data-dir", str(tmp_path)],
            env=os.environ | {"PYTHONIOENCODING": "ascii:strict"}, capture_output=True, text=True,
        )  # fmt: skip

    assert main(["rater", "add", "Zoë", "--data-dir", str(tmp_path)]) == 0
    for command, words in ((("rater", "list"), "Zo\\xeb"), (("audit",), " UTC  command line"),
                           (("rater", "revoke", "Ж"), "no rater '\\u0416'; there are: Zo\\xeb")):  # fmt: skip
        ended = run(*command)
        assert words in ended.stdout + ended.stderr and "Traceback" not in ended.stderr
