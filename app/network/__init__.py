"""The port itself: where it listens, how many connections strangers get, and what is refused shortly.

Begin with ``connections``. ``bind`` says who is at the other end, ``rate_limit`` how often somebody may
ask, ``refusals`` what a request that no browser sends is told.
"""
