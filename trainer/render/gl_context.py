"""Opens OpenGL without a screen, and says in one sentence what is missing where that fails."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from onedemo.core.process import GL_OFF, libegl_loads
from onedemo.errors import UserError


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
    on_linux = sys.platform == "linux"
    if on_linux and not libegl_loads():
        raise UserError(
            "cannot draw the robot: the library libEGL.so.1 is not installed; "
            "on Debian or Ubuntu run: apt-get install libegl1 libgl1-mesa-dri, then start onedemo again"
        )
    if os.environ.get("MUJOCO_GL", "").lower() in GL_OFF:
        raise UserError(
            f"cannot draw the robot: MUJOCO_GL={os.environ['MUJOCO_GL']} turns pictures off; "
            "unset it, or set MUJOCO_GL=egl"
        )
    try:
        # On Linux EGL by name: MuJoCo's own choice would want a screen in a process that set nothing.
        GLContext = importlib.import_module("mujoco.egl" if on_linux else "mujoco").GLContext
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # ImportError, RuntimeError or the window library's own, by backend
        raise UserError(
            "cannot draw the robot: no OpenGL driver that draws without a screen was found; "
            "on Debian or Ubuntu run: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, then start "
            f"onedemo again ({type(error).__name__} from MUJOCO_GL={os.environ.get('MUJOCO_GL', '')})"
        ) from error
    return context
