"""Opens OpenGL without a screen, and says in one sentence what is missing where that fails."""

from __future__ import annotations

import importlib
import os
import re
import sys
from typing import Any

from onedemo.core.process import GL_OFF, gl_library, gl_loads
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
    library = gl_library()
    if on_linux and not gl_loads(library):
        missing, packages = _NEEDS[library]
        raise UserError(
            f"cannot draw the robot: the library {missing} is not installed; on Debian or Ubuntu run: "
            f"apt-get install {packages}, then start onedemo again{_OTHERWISE[library]}"
        )
    if os.environ.get("MUJOCO_GL", "").lower() in GL_OFF:
        raise UserError(
            f"cannot draw the robot: MUJOCO_GL={os.environ['MUJOCO_GL']} turns pictures off; "
            "unset it, or set MUJOCO_GL=egl"
        )
    try:
        # On Linux by name: MuJoCo's own choice would want a screen in a process that set nothing.
        GLContext = importlib.import_module(f"mujoco.{library}" if on_linux else "mujoco").GLContext
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # ImportError, RuntimeError or the window library's own, by backend
        raise UserError(f"cannot draw the robot: {_why(library, error)}") from error
    return context


_NEEDS = {"egl": ("libEGL.so.1", "libegl1 libgl1-mesa-dri"), "osmesa": ("libOSMesa.so.8", "libosmesa6")}
"""Of each library its name, and the Debian packages that bring it with a driver."""
_OTHERWISE = {
    "egl": "; where EGL does not work (WSL2, some compute nodes), draw in software: "
    "apt-get install libosmesa6, and set MUJOCO_GL=osmesa",
    "osmesa": "; or unset MUJOCO_GL, to draw with EGL",
}


def _why(library: str, error: Exception) -> str:
    technical = f" ({type(error).__name__} from MUJOCO_GL={os.environ.get('MUJOCO_GL', '')})"
    device = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    if library == "egl" and device is not None:
        if isinstance(error, ValueError) or "MUJOCO_EGL_DEVICE_ID" in str(error):
            devices = re.search(r"between 0 and (\d+)", str(error))
            there = "" if devices is None else " but 0" if devices[1] == "0" else f": 0 to {devices[1]} are"
            return f"MUJOCO_EGL_DEVICE_ID={device} is not the number of a device{there}; unset it"
        technical += f"; MUJOCO_EGL_DEVICE_ID={device} is set: try without it"
    platform = os.environ.get("PYOPENGL_PLATFORM", library)
    if platform.lower() != library:
        return f"PYOPENGL_PLATFORM={platform} asks for another library than {library}; unset it"
    return (
        "no OpenGL driver that draws without a screen was found; on Debian or Ubuntu run: "
        f"apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, then start onedemo again{_OTHERWISE[library]}"
        f"{technical}"
        if library == "egl"
        else f"OSMesa does not work here{_OTHERWISE[library]}{technical}"
    )
