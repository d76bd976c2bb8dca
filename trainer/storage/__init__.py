"""The SQLite database of a data directory: ratings and all other events, clips, runs, accounts, audit log.

``Store`` opens it and is composed of the rest. One connection writes and another reads; every write is one
transaction. ``run_directory`` knows the files of a run beside the database, ``schema`` the steps between
versions.
"""
