"""The program `tagid-firmware`."""

from firmware_tools.cli.app import main

__all__ = ["main"]
