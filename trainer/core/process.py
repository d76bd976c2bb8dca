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

GL_OFF = ("disable", "disabled", "off", "false", "0")
"""Values of ``MUJOCO_GL`` that turn pictures off."""


def prepare_process() -> None:
    """Sets the environment variables that NumPy, MuJoCo and OpenCV read; those set by the user stay.

    The exception is ``MUJOCO_GL``: see ``choose_backend``.
    """
    # NumPy's matrix products here are small: threads of its own would only compete with the physics'.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # FFmpeg's own complaints about a broken file say less than our one sentence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    choose_backend()


def choose_backend() -> str:
    """Sets ``MUJOCO_GL``: EGL where its library loads, else off. Call before importing MuJoCo.

    MuJoCo reads ``MUJOCO_GL`` once, at its first import, and where that names a library that is not
    there the *import* dies with a bare AttributeError. So only "off" is taken from the user. Physics then
    works on any machine, and only pictures need the library; where they are off,
    ``render.gl_context.open_context`` says why.

    Returns:
        The value of ``MUJOCO_GL``; "" on systems whose own window library needs no choice.
    """
    wanted = os.environ.get("MUJOCO_GL", "")
    if sys.platform != "linux" or wanted.lower() in GL_OFF:
        return wanted
    os.environ["MUJOCO_GL"] = "egl" if libegl_loads() else "disable"
    return os.environ["MUJOCO_GL"]


def libegl_loads() -> bool:
    """Whether the library that draws without a screen can be loaded (Linux)."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def end_within(seconds: float, code: int = 0) -> None:
    """Ends the process after that time at the latest, whatever its threads are doing.

    For a program that has been told to end, and whose files are whole at any moment.

    Args:
        seconds: What an orderly end may take.
        code: Of the exit.
    """

    def end() -> None:
        time.sleep(seconds)
        sys.stdout.flush()
        os._exit(code)

    threading.Thread(target=end, name="onedemo-end", daemon=True).start()
