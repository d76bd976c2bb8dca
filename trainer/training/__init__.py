"""One training run: learner, trainer and its thread, queues of clips, checkpoints."""
