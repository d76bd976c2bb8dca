"""Reinforcement learning: the policy, what it sees, rollouts and trust region policy optimisation.

``rollouts.Collector`` is the one loop over control steps, under ``EpisodeRules``; ``trpo.Trpo`` improves a
``policy.Policy`` on what it gives. Nothing here knows where rewards come from.
"""
