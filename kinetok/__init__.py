"""kinetok: the motion of physically simulated characters, as tokens."""

import contextlib
import ctypes
import os
import sys

__version__ = "0.1.0"

# MuJoCo chooses its OpenGL backend while it is imported, so the choice is made here, before any room imports it. EGL
# draws without a display; it is asked for only where its library loads, for without it `import mujoco` itself fails.
if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    with contextlib.suppress(OSError):
        ctypes.CDLL("libEGL.so.1")
        os.environ.setdefault("MUJOCO_GL", "egl")
