"""The simulated robot: batched MuJoCo environments, kinematics, hand-coded task rewards.

``vector_env.make`` gives an environment of any number of lanes, by ``physics`` on the processor or by
``warp_physics`` on a GPU. ``task_rewards`` is shown and compared with, never learned from.
"""
