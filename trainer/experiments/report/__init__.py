"""Reports: blocks of text, tables and charts, written as Markdown, SVG and JSON (``document.write``).

What a report consists of is in ``blocks``; ``account`` adds which runs it is made of and what they cost,
``movie`` and ``strip`` the pictures of episodes.
"""
