"""What the page shows, as Jinja2 templates: every value is escaped unless it is markup already.

``render`` fills one in, and is all that there is to import; a value that is missing is an error. The files
beside it are the markup, one for each part of the page.
"""

from onedemo.app.templates.render import render

__all__ = ["render"]
