"""What a machine or an installation lacks for onedemo, in a sentence each. Imports nothing heavy itself."""

from __future__ import annotations

import importlib
import platform
import sys
import sysconfig
from collections.abc import Iterator
from importlib import metadata

_OLDEST_PYTHON = (3, 11)
_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
"""Packages that bring a module cv2 of their own, in the place of opencv-python-headless's."""


def unsupported() -> str:
    """Why onedemo cannot run on this system at all; "" if it can. Nothing else may be imported before."""
    if sys.platform == "win32":
        return (
            "onedemo does not run on Windows itself, which has no fcntl: install it in WSL2 (wsl --install), "
            "on Linux or on macOS, or use the Dockerfile"
        )
    if sys.version_info[:2] < _OLDEST_PYTHON:
        there = ".".join(map(str, sys.version_info[:3]))
        return (
            f"onedemo needs Python 3.11 or newer, and this is {there}: make an environment with a newer one"
        )
    return ""


def faults() -> list[str]:
    """All that is wrong with the installation, each with what helps; empty if nothing is."""
    return [*_system(), *packages(), *_opencv()]


def packages() -> Iterator[str]:
    """Packages that are missing, or older or newer than they may be."""
    from packaging.requirements import Requirement

    try:
        wanted = [Requirement(line) for line in metadata.requires("onedemo") or []]
    except metadata.PackageNotFoundError:
        yield "onedemo itself is not installed: pip install . in its folder"
        return
    for one in wanted:
        if one.marker is not None and not one.marker.evaluate({"extra": ""}):
            continue
        try:
            there = metadata.version(one.name)
        except metadata.PackageNotFoundError:
            yield f"{one.name} is missing, {one.specifier} is needed: install onedemo again"
            continue
        if not one.specifier.contains(there, prereleases=True):
            yield f"{one.name} is {there}, {one.specifier} is needed: install onedemo again"


def _system() -> Iterator[str]:
    if "musl" in (sysconfig.get_config_var("SOABI") or ""):
        yield (
            "this system's C library is musl (Alpine), for which MuJoCo, torch and OpenCV are not built: "
            "use Debian, Ubuntu or another system with glibc, or the Dockerfile"
        )
    if sys.platform == "darwin" and platform.machine() == "x86_64":
        yield "torch is not built any more for Macs with Intel processors: use the Dockerfile"


def _opencv() -> Iterator[str]:
    try:
        importlib.import_module("cv2")
    except ImportError as error:
        others = [name for name in _OPENCV if _is_there(name)]
        if others:
            yield (
                f"{' and '.join(others)} took the place of opencv-python-headless, and cannot be loaded here "
                f"({error}): pip uninstall {' '.join(others)}, "
                "then pip install --force-reinstall --no-deps opencv-python-headless"
            )
        elif not isinstance(error, ModuleNotFoundError):  # that is one of the packages that are missing
            yield f"OpenCV cannot be loaded ({error}): pip install --force-reinstall opencv-python-headless"


def _is_there(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True
