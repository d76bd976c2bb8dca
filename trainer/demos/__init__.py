"""Demonstration videos: import, normalise, list and read them (``library``).

A stranger's file is decoded in a process of its own that may do nothing else (``sandboxed_decoder``).
``ground_truth`` is what was behind a simulated demo: for annotators and evaluation, never for learning.
"""
