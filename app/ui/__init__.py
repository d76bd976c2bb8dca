"""The page: one session per browser, everything in it private to that browser, drawn by Viser.

``app.Page`` is the server behind the public port; what is private to Viser and used all the same is in
``viser_private`` alone. The tabs are in ``onedemo.app.tabs``.
"""
