"""The built and the installed program: one name in site-packages, beside whatever else somebody has."""

import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

from helpers.paths import ROOT
from onedemo.app.cli import main

pytestmark = pytest.mark.seam


def run(*command, cwd):
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout[-1500:]}\n{done.stderr[-1500:]}"
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what the repository holds, so that nothing is built in it."""
    copy = tmp_path_factory.mktemp("source")
    listed = run("git", "ls-files", "--cached", "--others", "--exclude-standard", cwd=ROOT).splitlines()
    for name in listed:
        if name.startswith(("trainer/", "app/", "static/")) or "/" not in name:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, cwd=source)  # sdist, wheel from it
    assert len(list(out.glob("onedemo-*.tar.gz"))) == 1
    (built,) = out.glob("*.whl")
    return built


def test_the_wheel_holds_one_name(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"onedemo"}
    assert "onedemo/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    for needed in ("demos/hopper-backflip.webm", "demos/hopper-backflip.hidden.npz", "page.js"):
        assert f"onedemo/static/{needed}" in names
    assert {"onedemo/app/templates/login.html", "onedemo/app/templates/watch.html"} < set(names)
    assert "onedemo/experiments/jobs/person_backflip.json" in names
    assert not [name for name in names if "/tests/" in name or "/load/" in name]


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_it_runs_beside_anything_of_the_same_names(kind, wheel, source, tmp_path):
    place = tmp_path / "environment"
    run(sys.executable, "-m", "venv", "--without-pip", place, cwd=tmp_path)
    python = place / "bin" / "python"
    (packages,) = (place / "lib").glob("python*/site-packages")
    # What onedemo needs comes from this environment; where onedemo itself is in it does not count there.
    (packages / "needs.pth").write_text(sysconfig.get_path("purelib") + "\n")
    before = {path.name for path in packages.iterdir()}
    what = [wheel] if kind == "wheel" else ["--no-build-isolation", "--editable", source]
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--quiet",
        "--no-deps",
        *what,
        cwd=tmp_path,
    )
    added = {path.name for path in packages.iterdir()} - before - {"__pycache__"}
    assert added and all(name.startswith(("onedemo", "__editable__")) for name in added), added

    home = tmp_path / "home"  # of somebody who has files of these names
    for name in ("app.py", "trainer.py"):
        (home / name).parent.mkdir(exist_ok=True)
        (home / name).write_text("raise SystemExit('this is mine')\n")
    (home / "static").mkdir()
    for command in ((place / "bin" / "onedemo",), (python, "-m", "onedemo.app.cli")):
        listed = run(*command, "demo", "list", "--data-dir", home / "data", cwd=home)
        assert "hopper-backflip" in listed
    said = "import onedemo, onedemo.app, onedemo.training.learner as l; print(onedemo.__file__, l.__file__)"
    for file in run(python, "-c", said, cwd=home).split():
        assert Path(file).is_relative_to(packages if kind == "wheel" else source)


def test_the_library_does_without_the_extra(tmp_path):
    """Reward and training are imported with none of its packages; the command says what to install."""
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["app"]
    names = sorted(re.match(r"[a-z0-9]+", line)[0] for line in extra)
    assert tuple(names) == main._APP_ONLY
    modules = [
        "onedemo." + ".".join(file.relative_to(ROOT / "trainer").with_suffix("").parts)
        for file in sorted((ROOT / "trainer").rglob("*.py"))
        if not file.stem.startswith("__") and "experiments" not in file.parts
    ]
    code = f"""
import importlib, sys
for name in {names}: sys.modules[name] = None  # as if it were not installed
for name in {modules}: importlib.import_module(name)
from onedemo.app.cli.main import main
sys.exit(main(["demo", "list", "--data-dir", "nowhere"]) or (main(["serve", "--data-dir", "nowhere"]) != 2))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1500:]
    assert done.stderr.count("pip install 'onedemo[app]'") == 1 and "Traceback" not in done.stderr
