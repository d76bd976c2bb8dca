"""Experiments over seeds: jobs, their runner, tables and reports; and speed."""
