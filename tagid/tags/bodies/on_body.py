"""A tag on one body, and what the body tells of the recording before its tag is read."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import off_axis
from tagid.tags.bodies.body_reading import BodyReading, BodySettings, Placed, seen_again
from tagid.tags.bodies.hypothesis import BodyModel, Candidate
from tagid.tags.bodies.layout_search import rings_of
from tagid.tags.bodies.middle import wave_in_the_middle
from tagid.tags.bodies.reader import BodyReader
from tagid.tags.bodies.reflectors_fit import Columns, alone
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout


def read_on_body(
    spectra: Spectra,
    layouts: Sequence[Layout],
    body: BodyModel,
    settings: BodySettings,
    hints: Sequence[complex] = (),
) -> BodyReading | None:
    """The best layout on a body, against every other arrangement; None where no layout can lie on one.

    A body tells how unevenly the turntable turned, or how oval it is (`BodyModel.seen`): first as if there
    were no tag, then once more beside the layout and the arrangement that were found, together, so that what
    it tells suits neither of them alone. Opposite reflectors make a round wall look oval: one that explains
    the echo as it is stated is not asked.

    Args:
        spectra: the scans.
        layouts: the enrolled ones; those with fewer than two reflectors off the axis cannot be read.
        body: the body below the reflectors.
        settings: search and priors.
        hints: further centres to try, x + jy, m.
    """
    rings = rings_of(layouts, settings)
    usable = [layout for layout in layouts if len(off_axis(layout)[0]) >= 2]
    if not usable:
        return None

    def read(seen: Spectra, poses: Sequence[Candidate]) -> BodyReading:
        return BodyReader(seen, usable, body, settings, poses).read(rings, hints)

    poses = body.poses(spectra)
    stated = None if body.turns else read(spectra, poses)
    if (
        stated is not None
        and stated.lead >= settings.clear_lead
        and stated.unexplained <= settings.clear_left
    ):
        return stated
    told = _as_told(spectra, body, poses[0], settings, read)
    if stated is None or told is None:
        return told or stated or read(spectra, poses)
    return min(told, stated, key=lambda reading: reading.least)


def _as_told(
    spectra: Spectra,
    body: BodyModel,
    begun: Candidate,
    settings: BodySettings,
    read: Callable[[Spectra, Sequence[Candidate]], BodyReading],
) -> BodyReading | None:
    """The reading of the scans as a body tells of them; None where it tells nothing."""
    seen = body.seen(spectra, begun.pose, None, begun.left / spectra.data.size)
    if seen is None:
        return None
    first = read(seen.spectra, [alone(seen.spectra, body, seen.pose)])
    best = first.layouts[0]
    other = next((placed for placed in first.others if placed.layout is None), best)
    beside = np.concatenate([_columns(first.spectra, placed) for placed in (best, other)], axis=1)
    if first.nominal_m >= settings.wide_m:
        # What may stand in the middle is asked of what is read: nothing may be bent to explain it before.
        beside = np.concatenate([beside, wave_in_the_middle(first.spectra, best)[:, None]], axis=1)
    again = seen_again(first, spectra, beside, first.least, settings)
    if again is None:
        return first
    return read(again.spectra, [alone(again.spectra, body, again.pose)])


def _columns(spectra: Spectra, placed: Placed) -> NDArray[np.complex128]:
    """(F, M, V) echo of an arrangement, a column for each term of its pattern."""
    values = Columns.of(spectra, None, placed.batch).values[0]
    return np.asarray(values[:, 1 : 1 + int(placed.batch.terms[0])])
