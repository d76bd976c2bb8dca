"""The robot as pictures, offscreen, and clips as one picture each."""
