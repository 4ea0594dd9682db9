"""Free space, and free cosines where the body's waves are not known."""

from __future__ import annotations

from tagid.reading.transfers.transfer import Transfer, cosines

BARE = Transfer("bare", "nothing that returns an echo", False, (1.0,), cosines(1, 0))
POINTS = Transfer("points", "a body that the waves pass", True, (1.0,), cosines(1, 0))
FACING = Transfer("facing", "a body", True, (1.0, 0.3, 0.1), cosines(3, 0), radius_sd_m=6e-3)
OPEN = Transfer(
    "open", "a body that hides them", True, (1.0, 0.5, 0.3, 0.1), cosines(4, 2), radius_sd_m=12e-3
)
THIN = Transfer("thin", "a thin wall", True, (1.0, 0.1), cosines(2, 0, 4e-3))
FILLED = Transfer(
    "filled", "a filled body", True, (1.0, 1.0, 0.5, 0.2), cosines(4, 0, 34e-3), radius_sd_m=3e-3
)
