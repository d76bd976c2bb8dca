"""The policy, what it sees, rollouts and trust region policy optimisation."""
