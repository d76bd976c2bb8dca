"""The web application and the command line on top of ``trainer``."""
