"""Simulated annotators and their errors, by name: ``oracle.make_rater``.

The oracle and the script measure a demo's hidden states, ``custom`` loads a rater of the user's own, and
``noise`` makes any of them err. Nothing that learns may import them.
"""
