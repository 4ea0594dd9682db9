"""Reflectors before a filled plastic vessel: powder, rice, oil or granulate, by the exact fields.

A filling of low loss is a lens: a reflector behind it is seen late, and stronger than one in front.
"""

from __future__ import annotations

from tagid.reading.transfers.wall import Walls, wall

FILLED = Walls((2e-3,), (2.5,), filling=(2.0, 2.3, 2.6, 3.0, 3.5))
"""Relative permittivities of fillings: oil and powder 2 to 3, rice and granulate more."""
RODS = tuple(wall("rod", "a filled vessel", FILLED, 4, polarisation) for polarisation in ("V", "H"))
