"""Devices that turn things and are not there: the other end of the wire, byte for byte.

Each core is a state machine without a clock of its own (bytes in, bytes out, time handed in); ports serve it.
"""
