"""What a demo's frames show: features of frozen networks (``encoders``), and the robot's pose in them.

``masks`` finds the robot, and ``silhouette`` reads its pose from the shape, learned from pictures of the
robot's own random states, once for a robot. Neither sees a rating or a demo's hidden states.
"""
