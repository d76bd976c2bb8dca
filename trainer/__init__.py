"""The training library: it learns a similarity reward from ratings, and a policy from that reward.

It never imports ``onedemo.app``, the web application on top of it. Importing it changes nothing of the
process; programs call ``onedemo.core.process.prepare_process`` first. A whole run without a page is
``training.simulated_run.train``; its settings are ``config.RunConfig``.
"""
