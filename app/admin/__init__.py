"""Backup and restore, and the doctor."""
