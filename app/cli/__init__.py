"""The ``onedemo`` command: one module for each group of commands, found by ``main``.

A command's module is imported only when the command is asked for, so help and version load nothing heavy.
Errors of the user end as one sentence and code 2.
"""
