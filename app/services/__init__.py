"""What all pages share: the runs, the live rollout, pictures of the demo."""
