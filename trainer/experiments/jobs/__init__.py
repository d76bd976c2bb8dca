"""What one process of an experiment does: settings and a seed in, figures out."""
