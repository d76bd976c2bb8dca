"""The tables of the paper and our own: which jobs they need, and what is reported of them.

Each module has a ``TABLE``, found by name through ``experiments.registry``. Goals are written down with the
plan, before any run; ``parts`` is what tables are made of.
"""
