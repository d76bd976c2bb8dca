"""Opens OpenGL without a screen, and says in one sentence what is missing where that fails.

MuJoCo reads ``MUJOCO_GL`` once, at its first import, and where that names a library that is not
there the *import* dies with a bare AttributeError. So the package calls ``choose_backend`` before
anything imports MuJoCo; physics then works on any machine, and only pictures need the library.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

from onedemo.errors import UserError

_OFF = ("disable", "disabled", "off", "false", "0")


def choose_backend() -> str:
    """Sets ``MUJOCO_GL``: EGL where its library loads, else off. Call before importing MuJoCo.

    Only "off" is taken from the user: with any other backend whose library is missing, the import
    of MuJoCo itself would fail. Where pictures are off, ``open_context`` says why.

    Returns:
        The value of ``MUJOCO_GL``; "" on systems whose own window library needs no choice.
    """
    wanted = os.environ.get("MUJOCO_GL", "")
    if sys.platform != "linux" or wanted.lower() in _OFF:
        return wanted
    os.environ["MUJOCO_GL"] = "egl" if _libegl_loads() else "disable"
    return os.environ["MUJOCO_GL"]


def open_context(width: int, height: int) -> Any:
    """Makes an offscreen GL context and makes it current in the calling thread.

    Args:
        width: Pixels.
        height: Pixels.

    Returns:
        A ``mujoco.GLContext``. It belongs to this thread; ``free()`` it here.

    Raises:
        UserError: If no GL library or no driver is installed, naming the Debian packages.
    """
    if os.environ.get("MUJOCO_GL", "").lower() in _OFF:
        if sys.platform == "linux" and not _libegl_loads():
            raise UserError(
                "cannot draw the robot: the library libEGL.so.1 is not installed; "
                "on Debian or Ubuntu run: apt-get install libegl1 libgl1-mesa-dri, then start onedemo again"
            )
        raise UserError(
            f"cannot draw the robot: MUJOCO_GL={os.environ['MUJOCO_GL']} turns pictures off; "
            "unset it, or set MUJOCO_GL=egl"
        )
    import mujoco

    try:
        context = mujoco.GLContext(width, height)
        context.make_current()
    except Exception as error:  # ImportError, RuntimeError or the window library's own, by backend
        raise UserError(
            "cannot draw the robot: no OpenGL driver that draws without a screen was found; "
            "on Debian or Ubuntu run: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, then start "
            f"onedemo again ({type(error).__name__} from MUJOCO_GL={os.environ.get('MUJOCO_GL', '')})"
        ) from error
    return context


def _libegl_loads() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True
