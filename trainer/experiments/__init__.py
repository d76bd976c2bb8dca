"""Experiments over seeds: which runs, in processes side by side, and what is reported of them.

A table (``tables``) plans jobs (``jobs``), ``runner`` runs what is missing and keeps each as a file, and
``report`` writes the result. ``speed`` is the benchmark of the program's own parts.
"""
