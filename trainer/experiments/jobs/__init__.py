"""What one process of an experiment does: settings and a seed in, figures out.

Each module has a ``run(settings, seed, scratch, cache)``; ``runner.KINDS`` gives them their names.
``method`` is the job behind most tables: one training with a simulated annotator, and its evaluation.
"""
