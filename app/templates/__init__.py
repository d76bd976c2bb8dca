"""What the page shows, as Jinja2 templates: every value is escaped unless it is markup already."""

from onedemo.app.templates.render import render

__all__ = ["render"]
