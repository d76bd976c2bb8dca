"""The page: one session per browser, its tabs, charts and clips, drawn by Viser.

``app.Page`` is the server behind the public port; a tab is a module with its own state, given a small frozen
``context``. What is private to Viser and used all the same is in ``viser_private`` alone.
"""
