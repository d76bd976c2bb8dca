"""Which clips are put to an annotator (``selection.choose``), and the settings of that.

Pure functions on arrays: rollouts and predictions in, questions out. The queues that ask them are in
``training``.
"""
