"""The turn of an enrolled body below a tag that is louder than what turns of the body.

Alone, such a body seems to stand where its echo imitates the tag best. Here its turn is searched together with
every layout. At frequency f let C (V, M) be a layout's pattern columns at one turn of the tag, u (V,) the
body's echo at one turn of the body, of unit length, and y (V,) the data, all without the room. Together they
explain

    b^H G^-1 b + |u^H y - w^H G^-1 b|^2 / (1 - w^H G^-1 w),   G = C^H C, b = C^H y, w = C^H u:

what the tag explains, and what the body adds to it. G and b do not depend on the body's turn, and w of a layout
is a sum over its reflectors, so every turn of the body with every turn of every layout costs one small product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Pose
from tagid.tags.bodies.reader import BodyReader, off_axis, rings_of
from tagid.tags.bodies.reflectors_fit import FACING, OPEN, Pattern, joined, solve
from tagid.tags.bodies.ring import ring_columns
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout

ANGLES = 60
"""Turns of the tag that are tried: 6 degrees, 5 mm on a mug's ring and 11 mm on a helmet's."""
STARTS = 4
"""Turns of the body that are fitted, each with its best layout."""
APART_RAD = np.deg2rad(12.0)
"""They differ at least by this."""
_RIDGE = 1e-3


@dataclass(frozen=True)
class _Start:
    """A body's turn and centre with a layout on it, and the energy that both explain of the thinned spectra."""

    explained: float
    pose: Pose
    layout: Layout
    angles: tuple[float, ...]
    offset_m: float


def read_below(
    spectra: Spectra,
    layouts: Sequence[Layout],
    body: BodyModel,
    settings: BodySettings,
    centres: Sequence[complex],
    least: float = np.inf,
) -> BodyReading | None:
    """The reading on a body whose turn is sought together with a layout on it.

    Args:
        spectra, layouts, body, settings: as of `reader.read_on_body`.
        centres: where the body may stand, x + jy, m.
        least: energy that another pose of the body leaves with a tag; None is returned where no pose found
            here leaves less.
    """
    usable = [layout for layout in layouts if len(off_axis(layout)[0]) >= 2]
    starts = _starts(spectra.thinned(2), usable, body, settings, centres)
    found: list[Candidate] = []
    best = np.inf
    for start in starts:
        alone = _alone(spectra, body, start.pose)
        reader = BodyReader(spectra, [start.layout], body, settings, [alone])
        rows = [
            reader.batch(start.layout, start.pose.centre, start.offset_m, start.angles, pattern)
            for pattern in (FACING, OPEN)
        ]
        batch, left = reader.fitter.fitted(joined(rows), 6)
        i = int(np.argmin(left))
        if left[i] < best:
            best, at = float(left[i]), batch.at[i]
            found = [_alone(spectra, body, Pose((float(at[3]), float(at[4])), float(at[5])))]
    if not found or best >= least:
        return None
    return BodyReader(spectra, usable, body, settings, found).read(rings_of(layouts, settings), ())


def _alone(spectra: Spectra, body: BodyModel, pose: Pose) -> Candidate:
    """A pose with what the body alone leaves there."""
    echo = body.echo(spectra, np.array([pose.centre]), np.array([pose.turn_rad]))
    return Candidate(pose, float(solve(spectra.data, centred(echo)[:, :, None]).left[0]))


def _starts(
    spectra: Spectra,
    layouts: Sequence[Layout],
    body: BodyModel,
    settings: BodySettings,
    centres: Sequence[complex],
) -> list[_Start]:
    """The body's turns at which it explains most together with some layout, best first."""
    turns = np.arange(0, 2 * np.pi, settings.turn_step_rad)
    every: list[_Start] = []
    for centre in centres:
        echoes = centred(body.echo(spectra, np.full(len(turns), centre), turns))
        size = np.linalg.norm(echoes, axis=-1, keepdims=True)
        search = _Search(spectra, np.moveaxis(echoes / np.maximum(size, 1e-300), 0, 2), centre)
        for layout in layouts:
            for offset in _offsets(layout, settings):
                explained, angles = search.explained(layout, offset, FACING)
                every += [
                    _Start(float(explained[i]), Pose((centre.real, centre.imag), float(turn)), layout, a, offset)
                    for i, (turn, a) in enumerate(zip(turns, angles, strict=True))
                ]
    every.sort(key=lambda start: -start.explained)
    kept: list[_Start] = []
    for one in every:
        away = (np.angle(np.exp(1j * (one.pose.turn_rad - other.pose.turn_rad))) for other in kept)
        if all(abs(a) >= APART_RAD for a in away):
            kept.append(one)
        if len(kept) == STARTS:
            break
    return kept


def _offsets(layout: Layout, settings: BodySettings) -> tuple[float, ...]:
    """Apparent radii tried, relative to the nominal ones, m."""
    wide = float(off_axis(layout)[0].mean()) >= settings.wide_m
    return (0.0,) if wide else settings.rings_m


class _Search:
    """Products that all layouts about one centre share.

    Args:
        spectra: capture, at few frequencies.
        units: (F, V, T) echo of the body in every turn, of unit length, without the room.
        centre: of body and reflectors, x + jy, m.
    """

    def __init__(self, spectra: Spectra, units: NDArray[np.complex128], centre: complex) -> None:
        self._spectra = spectra
        self._units = units
        self._centre = centre
        self._along = np.einsum("fvt,fv->ft", units.conj(), spectra.data)
        self._rings: dict[tuple[float, Pattern], NDArray[np.complex128]] = {}

    def _columns(self, radius_m: float, pattern: Pattern) -> NDArray[np.complex128]:
        """(F, N, M, V) columns of reflectors at every angle of a ring."""
        key = (round(radius_m, 6), pattern)
        if key not in self._rings:
            angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
            columns = ring_columns(self._spectra, self._centre, radius_m, pattern, angles)
            self._rings[key] = columns.reshape(len(columns), ANGLES, pattern.terms, -1)
        return self._rings[key]

    def explained(
        self, layout: Layout, offset_m: float, pattern: Pattern
    ) -> tuple[NDArray[np.float64], list[tuple[float, ...]]]:
        """(T,) energy that body and layout explain in the tag's best turn, and its reflectors' angles there."""
        radii, angles, _ = off_axis(layout)
        step = 2 * np.pi / ANGLES
        columns: NDArray[np.complex128] | float = 0.0
        for radius, angle in zip(radii, angles, strict=True):
            ring = self._columns(float(radius) + offset_m, pattern)
            columns = columns + np.roll(ring, -round(float(angle) / step), axis=1)
        across = np.asarray(columns).conj()
        gram = across @ np.swapaxes(np.asarray(columns), -1, -2)
        load = _RIDGE * np.einsum("fnmm->fn", gram).real / pattern.terms
        inverse = np.linalg.inv(gram + load[..., None, None] * np.eye(pattern.terms))
        right = across @ self._spectra.data[:, None, :, None]
        solved = inverse @ right
        tag = (right.conj() * solved).sum(axis=(2, 3)).real
        # (F, N, M, T)
        side = across @ self._units[:, None]
        rest = self._along[:, None] - (side.conj() * solved).sum(axis=2)
        spread = 1 - (side.conj() * (inverse @ side)).sum(axis=2).real
        total = (tag[..., None] + np.abs(rest) ** 2 / np.maximum(spread, 0.02)).sum(axis=0)
        best = total.argmax(axis=0)
        exact = [tuple(float(a) for a in angles + i * step) for i in best]
        return total[best, np.arange(total.shape[1])], exact
