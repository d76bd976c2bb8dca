"""The tabs of the page: each draws itself into one browser and takes what is pressed there.

A tab is a module with its own state, given a small frozen ``context``. What all of them share is in
``context``, ``pressing``, ``strings`` and ``clip_player``.
"""
