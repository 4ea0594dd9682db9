"""Emulated robots and tables: the other end of the wire, byte for byte.

Each core is a state machine without a clock of its own (bytes in, bytes out, time passed in); ports serve it.
"""
