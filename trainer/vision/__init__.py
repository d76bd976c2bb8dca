"""What a demo's frames show: features of frozen networks (``encoders``), and the robot's pose in them.

``pose_estimator`` learns the pose from pictures of the robot's own random states, once for robot and
encoder. Neither sees a rating or a demo's hidden states.
"""
