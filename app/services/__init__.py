"""What all pages share: the runs (``run_manager``), the live rollout, pictures of the demo.

There is one of each in a server, used by many threads. A page asks for it and is called back; it owns none
of them.
"""
