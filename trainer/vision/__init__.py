"""Frozen encoders of demo frames, and the robot's pose read from them."""
