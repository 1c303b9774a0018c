"""Adaptive streaming: which records a client gets next, from its pose, its bandwidth and what it holds already.

Pure functions and small state machines: no socket, no clock (time is an argument), no torch. The same objects drive the
simulator and the server.
"""
