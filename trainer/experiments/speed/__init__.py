"""Speed, part by part, each side by side with a peer or with the machine's limit.

A part is a module with ``measure(quick)`` that gives ``figures``; ``parts`` knows them by name. The parts
of the server are outside the wheel, in ``tests/load``.
"""
