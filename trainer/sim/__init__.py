"""The simulated robot: batched MuJoCo environments, kinematics, hand-coded task rewards."""
