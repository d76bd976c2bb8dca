"""Demonstration videos: import, normalise, list, read; and what was behind a simulated one."""
