"""Robots: all that is particular to one, and nothing else in the code knows a robot's number.

``robot`` says what a robot is: model, control step, actions, observations, what of it is compared, camera.
``registry`` finds one by its name; each built-in robot has a module of its own.
"""
