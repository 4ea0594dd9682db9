"""The turn of an enrolled body below a tag that is louder than what turns of the body.

Alone, such a body seems to stand where its echo imitates the tag best. Here its turn is searched together
with every layout (`layout_search`), a few turns are fitted, and the layouts are read at the best one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.tags.bodies.arrangement import off_axis
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Pose
from tagid.tags.bodies.layout_search import LayoutSearch, rings_of, turned_by
from tagid.tags.bodies.posing import CENTRE_REACH_M
from tagid.tags.bodies.reader import BodyReader
from tagid.tags.bodies.reflectors_fit import FACING, OPEN, alone, joined
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout

STARTS = 4
"""Turns of the body that are fitted, each with its best layout."""
CENTRES_APART_M = 2e-3
APART_RAD = np.deg2rad(12.0)
"""They differ at least by this."""


@dataclass(frozen=True)
class _Start:
    """A body's pose with a layout on it, and the energy that both explain of the thinned spectra."""

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
        spectra, layouts, body, settings: as of `on_body.read_on_body`.
        centres: where the body may stand, x + jy, m, beside where it seems to stand alone and the axis.
        least: energy that another pose of the body leaves with a tag; None is returned where no pose found
            here leaves less.
    """
    usable = [layout for layout in layouts if len(off_axis(layout)[0]) >= 2]
    tried: list[complex] = []
    for one in (*centres, *(found.pose.centre for found in body.poses(spectra)), 0j):
        if abs(one) <= CENTRE_REACH_M and all(abs(one - other) > CENTRES_APART_M for other in tried):
            tried.append(one)
    starts = _starts(spectra.thinned(2), usable, body, settings, tried)
    found: list[Candidate] = []
    best = np.inf
    for start in starts:
        reader = BodyReader(spectra, [start.layout], body, settings, [alone(spectra, body, start.pose)])
        rows = [
            reader.batch(start.layout, start.pose.centre, start.offset_m, start.angles, pattern)
            for pattern in (FACING, OPEN)
        ]
        batch, left = reader.fitter.fitted(joined(rows), 6)
        i = int(np.argmin(left))
        if left[i] < best:
            best, at = float(left[i]), batch.at[i]
            found = [alone(spectra, body, Pose((float(at[3]), float(at[4])), float(at[5])))]
    if not found or best >= least:
        return None
    return BodyReader(spectra, usable, body, settings, found).read(rings_of(layouts, settings), ())


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
        search = LayoutSearch(spectra, body.echo(spectra, np.full(len(turns), centre), turns), centre)
        for layout in layouts:
            for offset in settings.radius_offsets_m(float(off_axis(layout)[0].mean())):
                explained = search.explained(layout, offset, FACING)
                best = zip(explained.argmax(axis=0), explained.max(axis=0), turns, strict=True)
                for i, value, turn in best:
                    pose = Pose((centre.real, centre.imag), float(turn))
                    every.append(_Start(float(value), pose, layout, turned_by(layout, int(i)), offset))
    every.sort(key=lambda start: -start.explained)
    kept: list[_Start] = []
    for one in every:
        away = (np.angle(np.exp(1j * (one.pose.turn_rad - other.pose.turn_rad))) for other in kept)
        if all(abs(a) >= APART_RAD for a in away):
            kept.append(one)
        if len(kept) == STARTS:
            break
    return kept
