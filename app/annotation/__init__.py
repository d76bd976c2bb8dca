"""The rules of rating and comparing, without any page: who gets which clip, and what a press does.

``RatingSession`` and ``ComparisonSession`` are one person at one page, ``assignment`` deals clips out to all
of them, ``presses`` is what a browser may say, ``agreement`` how far people agree.
"""
