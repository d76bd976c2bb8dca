"""Simulated annotators and their errors.

They may read a demo's ground truth; nothing that learns may import them.
"""
