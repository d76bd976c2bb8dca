"""The robot as pictures, drawn offscreen by MuJoCo (``renderer``), and clips as one picture each.

A GL context belongs to one thread: ``RenderThread`` draws for all others. ``gl_context`` says in a sentence
what is missing where nothing can be drawn.
"""
