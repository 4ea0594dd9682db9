"""Every turn of a layout with every turn of the body below it, about one centre.

At frequency f let C (V, M) be a layout's pattern columns at one turn of the tag, u (V,) the body's echo at
one turn of the body, of unit length, and y (V,) the data, all without the room. Together they explain

    b^H G^-1 b + |u^H y - w^H G^-1 b|^2 / (1 - w^H G^-1 w),   G = C^H C, b = C^H y, w = C^H u:

what the tag explains, and what the body adds to it. G and b do not depend on the body's turn, and C is a sum
over the layout's reflectors, whose columns all layouts share.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import off_axis
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.reflectors_fit import Pattern
from tagid.tags.bodies.ring import ring_columns
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout

ANGLES = 60
"""Turns of the tag that are tried: 6 degrees, 5 mm on a mug's ring and 11 mm on a helmet's."""
_RIDGE = 1e-3
_LEAST_SPREAD = 0.02
"""Least share of the body's echo beyond the tag's columns; what is less is not told from the tag."""


class LayoutSearch:
    """Products that all layouts about one centre share.

    Args:
        spectra: capture, at few frequencies.
        echoes: (T, F, V) echo of the body in every turn.
        centre: of body and reflectors, x + jy, m.
    """

    def __init__(self, spectra: Spectra, echoes: NDArray[np.complex128], centre: complex) -> None:
        self._spectra = spectra
        self._centre = centre
        units = centred(echoes)
        units = units / np.maximum(np.linalg.norm(units, axis=-1, keepdims=True), 1e-300)
        self._units = np.ascontiguousarray(np.moveaxis(units, 0, 2))
        self._along = np.einsum("fvt,fv->ft", self._units.conj(), spectra.data)
        self._rings: dict[tuple[float, Pattern], NDArray[np.complex128]] = {}

    def explained(self, layout: Layout, offset_m: float, pattern: Pattern) -> NDArray[np.float64]:
        """(ANGLES, T) energy explained by a layout in turns 2 pi / ANGLES apart and the body in its turns.

        Args:
            layout: its reflectors off the axis.
            offset_m: added to their nominal radii, m.
            pattern: of every reflector.
        """
        radii, angles, _ = off_axis(layout)
        step = 2 * np.pi / ANGLES
        columns = np.zeros(1, dtype=np.complex128)
        for radius, angle in zip(radii, angles, strict=True):
            ring = self._columns(float(radius) + offset_m, pattern)
            columns = columns + np.roll(ring, -round(float(angle) / step), axis=1)
        across = columns.conj()
        gram = across @ np.swapaxes(columns, -1, -2)
        load = _RIDGE * np.einsum("fnmm->fn", gram).real / pattern.terms
        inverse = np.linalg.inv(gram + load[..., None, None] * np.eye(pattern.terms))
        right = across @ self._spectra.data[:, None, :, None]
        solved = inverse @ right
        tag = (right.conj() * solved).sum(axis=(2, 3)).real
        # (F, N, M, T)
        side = across @ self._units[:, None]
        rest = self._along[:, None] - (side.conj() * solved).sum(axis=2)
        spread = 1 - (side.conj() * (inverse @ side)).sum(axis=2).real
        total = tag[..., None] + np.abs(rest) ** 2 / np.maximum(spread, _LEAST_SPREAD)
        return np.asarray(total.sum(axis=0))

    def _columns(self, radius_m: float, pattern: Pattern) -> NDArray[np.complex128]:
        """(F, ANGLES, M, V) columns of a reflector at every angle of a ring."""
        key = (round(radius_m, 6), pattern)
        if key not in self._rings:
            angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
            columns = ring_columns(self._spectra, self._centre, radius_m, pattern, angles)
            self._rings[key] = columns.reshape(len(columns), ANGLES, pattern.terms, -1)
        return self._rings[key]


def turned_by(layout: Layout, index: int) -> tuple[float, ...]:
    """Angles of a layout's reflectors off the axis in one of the turns of `LayoutSearch.explained`, rad."""
    return tuple(float(a) for a in off_axis(layout)[1] + 2 * np.pi / ANGLES * index)


def rings_of(layouts: Sequence[Layout], settings: BodySettings) -> list[float]:
    """Radii at which arrangements are searched, m: those of the layouts, merged within 8 mm."""
    nominal: list[float] = []
    for value in sorted(float(r) for layout in layouts for r in off_axis(layout)[0]):
        if not nominal or value - nominal[-1] > 8e-3:
            nominal.append(value)
    found: list[float] = []
    for value in nominal:
        found += [value + offset for offset in settings.radius_offsets_m(value)]
    kept: list[float] = []
    for value in sorted(found):
        if not kept or value - kept[-1] > 8e-3:
            kept.append(value)
    return kept
