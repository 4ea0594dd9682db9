"""Ending a scan before the turn does: readings at fixed shares of a turn, and their calibration."""
