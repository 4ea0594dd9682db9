"""Emulated robots and tables, compatible byte for byte with the real ones.

Each core is a state machine without a clock (bytes in, bytes out, time as an argument), served on a port.
"""
