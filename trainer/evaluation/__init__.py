"""What a trained policy is worth: whole episodes of it, against the demo's ground truth.

``episodes`` performs and summarises them, ``metrics`` counts turns and landings, ``time_warping`` aligns an
episode with the demo before they are compared.
"""
