"""What a trained policy is worth: whole episodes against the demo's ground truth."""
