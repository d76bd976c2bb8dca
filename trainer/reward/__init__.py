"""The reward model: from ratings to a predicted rating of any state beside any demo frame.

``model.fit`` makes a ``Snapshot`` of either kind, the learned distance or the paper's network.
``episode_rules`` turns a snapshot into rewards, starts and ends of episodes; ``dataset`` reads the ratings.
"""
