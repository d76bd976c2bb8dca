"""What everything stands on: files that are whole or absent, names that are safe as paths, the processor.

Also what a program sets of its process at its start (``process``), and checks of settings (``ranges``).
It imports nothing of onedemo but its errors.
"""
