"""The training library: it learns a similarity reward from ratings and a policy from that reward.

It never imports ``app``, the web application on top of it.
"""

from trainer.gl import choose_backend

# MuJoCo reads its choice of GL library once, at its first import, wherever in the package that is.
choose_backend()
