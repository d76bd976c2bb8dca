"""The training library: it learns a similarity reward from ratings and a policy from that reward.

It never imports ``app``, the web application on top of it.
"""

import os

from onedemo.render.gl_context import choose_backend

# NumPy's matrix products here are small: threads of its own would only fight with the physics'.
# Read once, at NumPy's first import.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# MuJoCo reads its choice of GL library once, at its first import, wherever in the package that is.
choose_backend()
