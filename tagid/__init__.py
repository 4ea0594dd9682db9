"""Reads the identity of a tagged object from ultra-wideband radar scans of it turning.

The package is layered: devices and files below, imaging and tag reading above them, commands on top.
"""

__version__ = "0.1.0"
