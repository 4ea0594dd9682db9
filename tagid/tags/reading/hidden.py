"""Sectors of the turn in which something hides a reflector: a person, a cable, a part of the table.

Such a reflector sends nothing there, which no constant amplitude describes, and other explanations of the
echo then leave less than its layout. In the views in which all of a layout's reflectors are seen nothing is
amiss: they are read as a shorter turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import outward
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import Fit
from tagid.tags.reading.squares import least_squares

WIDTHS_DEG = (60.0, 90.0, 120.0, 150.0)
STEP_DEG = 15.0
LEAST_NATS = 10.0
"""Energy over noise that one hidden sector must explain: its place and width are one of 96, 4.6 nats."""
LEAST_SEEN, LEAST_VIEWS = 0.4, 12
"""Share of the views, and views, in which all reflectors must be seen: with less, many arrangements fit."""
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class HiddenSectors:
    """Where reflectors of a layout are hidden.

    Attributes:
        seen: (views,) whether all of them are seen.
        widths_deg: (K,) of the sector in which each is hidden, 0 for none.
        nats: energy over noise that the sectors explain beyond constant amplitudes.
    """

    seen: NDArray[np.bool_]
    widths_deg: NDArray[np.float64]
    nats: float


def hidden_sectors(field: MatchedField, best: Fit) -> HiddenSectors | None:
    """The sectors that explain most at the place of a layout's fit; None where they explain too little.

    Args:
        field: matched field of the scans.
        best: the layout's fit with constant amplitudes.
    """
    angle = np.arctan2(field.antenna[:, 1], field.antenna[:, 0])
    masks, widths = _masks(angle)
    size, count = best.layout.size, len(masks)
    d = best.distances(field)
    pattern = best.aspect.weight(field.antenna, best.positions, outward(best.positions, best.centre_m))
    usual = np.ones_like(d) if pattern is None else pattern
    templates = np.concatenate(
        [
            field.templates(np.broadcast_to(away, masks.shape), (masks * even).astype(np.float32))
            for away, even in zip(d, usual, strict=True)
        ]
    )
    b, gram = field.correlate(templates), field.gram(templates)

    def explained(chosen: NDArray[np.intp]) -> NDArray[np.float64]:
        """(n,) energy explained with each reflector's mask (n, K)."""
        sets = chosen + count * np.arange(size)
        return least_squares(b[sets], gram[sets[:, :, None], sets[:, None]])[1]

    alike = explained(np.repeat(np.arange(count)[:, None], size, axis=1))
    noise = max(field.noise_variance, 1e-30)
    # Each reflector's own sector, from none and from one that hides them all.
    found = max(
        (_climbed(explained, np.full(size, start), count) for start in (0, int(np.argmax(alike)))),
        key=lambda one: float(explained(one[None])[0]),
    )
    nats = (float(explained(found[None])[0]) - float(alike[0])) / noise
    hidden = int(np.count_nonzero(found))
    if not hidden or nats < LEAST_NATS * hidden:
        return None
    seen = masks[found].min(axis=0) > 0
    if np.count_nonzero(seen) < max(LEAST_VIEWS, LEAST_SEEN * len(seen)) or seen.all():
        return None
    return HiddenSectors(seen, widths[found], nats)


def _masks(angle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, views) masks, 0 in the hidden sector, the first without one; and their widths (N,), deg."""
    starts = np.deg2rad(np.arange(0.0, 360.0, STEP_DEG))
    off = np.abs(np.angle(np.exp(1j * (angle - starts[:, None]))))
    masks = [np.ones((1, len(angle))), *((off > np.deg2rad(w / 2)).astype(float) for w in WIDTHS_DEG)]
    return np.concatenate(masks), np.concatenate([[0.0], np.repeat(WIDTHS_DEG, len(starts))])


def _climbed(
    explained: Callable[[NDArray[np.intp]], NDArray[np.float64]], chosen: NDArray[np.intp], count: int
) -> NDArray[np.intp]:
    """(K,) masks after exchanging one reflector's at a time while that explains more.

    Args:
        explained: energy explained by rows of masks (n, K).
        chosen: (K,) masks to begin with.
        count: number of masks.
    """
    best = float(explained(chosen[None])[0])
    for _ in range(_ROUNDS):
        for k in range(len(chosen)):
            trials = np.repeat(chosen[None], count, axis=0)
            trials[:, k] = np.arange(count)
            chosen[k] = int(np.argmax(explained(trials)))
        now = float(explained(chosen[None])[0])
        if now <= best * (1 + 1e-9):
            break
        best = now
    return chosen
