"""The SQLite database: schema, events, accounts, audit log.

One connection, one lock; every write is one transaction.
"""
