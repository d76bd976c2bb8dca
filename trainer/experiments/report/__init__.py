"""Reports: blocks of text, tables and charts, as Markdown and JSON."""
