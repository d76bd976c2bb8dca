"""Care of a data directory: backup and restore while people rate (``backup``), and the ``doctor``.

Both read it past the running server. A backup is whole or absent; the doctor changes nothing, and says of
each fault what to do about it.
"""
