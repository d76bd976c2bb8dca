"""What a program of onedemo sets of its process, once, at its very start.

Importing onedemo changes nothing of a process: a library has no right to. The command, the workers of an
experiment and the tests call ``prepare_process`` instead, before anything imports NumPy or MuJoCo, which
read these variables once, at their first import.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from contextlib import suppress
from typing import Literal

GL_OFF = ("disable", "disabled", "off", "false", "0")
"""Values of ``MUJOCO_GL`` that turn pictures off."""


def prepare_process() -> None:
    """Sets the environment variables that NumPy, MuJoCo and OpenCV read; those set by the user stay.

    The exceptions are ``MUJOCO_GL`` and ``PYOPENGL_PLATFORM``: see ``choose_backend``.
    """
    # NumPy's matrix products here are small: threads of its own would only compete with the physics'.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # FFmpeg's own complaints about a broken file say less than our one sentence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    choose_backend()


def choose_backend() -> str:
    """Sets ``MUJOCO_GL`` to what draws: EGL, OSMesa if the user asks for it, "disable" where it is missing.

    Call before importing MuJoCo, which reads ``MUJOCO_GL`` once, at its first import, and where that names a
    library that is not there the *import* dies with a bare AttributeError. So only "off" and "osmesa"
    (drawing in software, for machines on which EGL does not work) are taken from the user. Physics then
    works on any machine, and only pictures need the library; where they are off,
    ``render.gl_context.open_context`` says why. ``PYOPENGL_PLATFORM`` is set to the same: MuJoCo refuses
    any other.

    Returns:
        The value of ``MUJOCO_GL``; "" on systems whose own window library needs no choice.
    """
    wanted = os.environ.get("MUJOCO_GL", "")
    if sys.platform != "linux" or wanted.lower() in GL_OFF:
        return wanted
    library = os.environ["PYOPENGL_PLATFORM"] = gl_library()
    os.environ["MUJOCO_GL"] = library if gl_loads(library) else "disable"
    return os.environ["MUJOCO_GL"]


def end_within(seconds: float, code: int = 0) -> None:
    """Ends the process after that time at the latest, whatever its threads are doing.

    For a program that has been told to end, and whose files are whole at any moment.

    Args:
        seconds: What an orderly end may take.
        code: Of the exit.
    """

    def end() -> None:
        time.sleep(seconds)
        with suppress(Exception):  # whoever read it may have gone
            sys.stdout.flush()
        os._exit(code)

    threading.Thread(target=end, name="onedemo-end", daemon=True).start()


def gl_library() -> Literal["egl", "osmesa"]:
    """What draws without a screen on Linux, as ``MUJOCO_GL`` says, or said before it was switched off."""
    gl, platform = (os.environ.get(name, "").lower() for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"))
    return "osmesa" if gl == "osmesa" or (gl == "disable" and platform == "osmesa") else "egl"


def gl_loads(library: Literal["egl", "osmesa"]) -> bool:
    """Whether that library can be loaded."""
    for name in {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6")}[library]:
        try:
            ctypes.CDLL(name)
            return True
        except OSError:
            continue
    return False
