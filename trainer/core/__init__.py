"""Files that are whole or absent, names that are safe as paths, and the processor.

Imports nothing of onedemo but its errors.
"""
