"""The reward model: from ratings to a predicted rating of any state beside any demo frame."""
