"""Exact fields at round bodies, for the simulator and for the reader of tags on such bodies."""
