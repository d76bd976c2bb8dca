"""One training run, from the first clip to the last step.

``learner`` learns without files or threads, ``training_run`` adds database, files and queues, and two things
drive it: ``thread.Trainer`` at the pace of people, ``simulated_run.train`` with a simulated annotator.
"""
