"""The web application and the command line, on top of the library.

``http`` is the public port, ``ui`` the page behind it, ``annotation`` the rules of rating; ``cli`` starts
all of it. Its packages import each other in the order of ``docs/architecture.md``.
"""
