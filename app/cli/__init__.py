"""The ``onedemo`` command."""
