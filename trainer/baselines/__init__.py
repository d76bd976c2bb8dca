"""What the method is compared with, and what made the built-in demos.

TRPO on a hand-coded reward, learning from comparisons of trajectories (Christiano et al. 2017), and search
over action sequences. ``make_demo`` turns the best of them into a demo with its hidden states.
"""
