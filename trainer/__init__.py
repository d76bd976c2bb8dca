"""The training library: it learns a similarity reward from ratings and a policy from that reward.

It never imports ``app``, the web application on top of it.
"""
