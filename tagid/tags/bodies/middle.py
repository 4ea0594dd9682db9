"""Whether a reflector stands in the middle of a tag on an enrolled shell or box.

Arrangements on a ring do not hold it, and on the rotation axis it is removed with the room. Off the axis it
adds one column about the ring's centre to what body and reflectors explain: `with_middle`. Alike reflectors
return alike, so its energy there is compared with what it would be at their mean power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import off_axis
from tagid.tags.bodies.body_reading import BodyReading, Placed
from tagid.tags.bodies.hypothesis import BodyModel
from tagid.tags.bodies.reflectors_fit import Columns, solve
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout
from tagid.tags.verdicts.verdict import Code, Verdict

ASPECTS = 36
LEAST_EXPECTED = 0.06
"""A reflector in the middle is told where one alike would add so much to the tag's energy: from 4 to 6 mm off
the axis at 110 mm."""
LEAST_NOISE = 4.0
"""And so many times what everything else leaves in as many amplitudes."""
STANDS = 0.30
"""It is there from this share on. Of 40 tags on helmets of our simulator, 6 and 10 mm off the axis, those
without one have up to 0.09, those with one 0.46 to 1.1; on a shell of points 0.07, and 0.39 to 0.41."""


@dataclass(frozen=True)
class Middle:
    """A reflector in the middle of a ring of reflectors.

    Attributes:
        share: power that it seems to have, over the mean power of a reflector on the ring; noise subtracted.
        expected: energy by which one alike would show beyond body and ring.
        error: energy that everything else leaves in as many amplitudes.
    """

    share: float
    expected: float
    error: float

    def shows(self, tag: float) -> bool:
        """Whether it can be told, beside a tag of so much energy."""
        return self.expected >= max(LEAST_EXPECTED * tag, LEAST_NOISE * self.error)


def contradicts(reading: BodyReading, layout: Layout) -> Verdict | None:
    """The refusal of a layout on an enrolled body where its middle is not as the layout has it.

    Args:
        reading: its best layout is the one to be judged.
        layout: the same, with the reflectors on its axis.

    Returns:
        The refusal; None where nothing speaks against the layout.
    """
    found = in_the_middle(reading)
    if not found.shows(reading.tag):
        return None
    has = len(off_axis(layout)[0]) < layout.size
    if has and found.share < STANDS:
        return Verdict("unknown", Code.MISSING, f"the reflector in the middle of {layout.name} is missing")
    if not has and found.share > STANDS:
        return Verdict("unknown", Code.EXTRA, f"a reflector stands in the middle of {layout.name}")
    return None


def wave_in_the_middle(spectra: Spectra, placed: Placed) -> NDArray[np.complex128]:
    """(F, V) echo of a point in the middle of an arrangement, without what is constant over the views."""
    distance = np.hypot(np.abs(spectra.antenna - placed.centre), spectra.height_m)
    return centred(spectra.waves(distance) * (spectra.distance_m / distance) ** 2)


def with_middle(spectra: Spectra, body: BodyModel, placed: Placed) -> Placed:
    """An arrangement with a reflector more in the middle of its ring, where that is worth its amplitudes.

    In a box a tag of three in a row leaves a fifth to a half of its echo without.

    Args:
        spectra: the scans.
        body: the enrolled one.
        placed: on it, where it was fitted.
    """
    known = Columns.of(spectra, body, placed.batch).values[:, :, : 1 + int(placed.batch.terms[0])]
    wave = wave_in_the_middle(spectra, placed)[None, :, None]
    left = float(solve(spectra.data, np.concatenate([known, wave], axis=2)).left[0])
    charged = left + placed.charged - placed.left + spectra.amplitude_cost
    return replace(placed, left=left, charged=charged) if charged < placed.charged else placed


def with_middles(
    spectra: Spectra,
    body: BodyModel,
    layouts: Sequence[Layout],
    wide_m: float,
    several: Sequence[Placed],
) -> list[Placed]:
    """Arrangements with what stands in their middle, where they may have it, the likeliest first.

    Args:
        spectra, body: as of `with_middle`.
        layouts: where none has a reflector on its axis, none is sought.
        wide_m: from this mean radius on a body is a shell or a box, and passes the wave.
        several: fitted arrangements; one of a layout has what the layout has.
    """
    has = {one.name for one in layouts if len(off_axis(one)[0]) < one.size}

    def may(placed: Placed) -> bool:
        own = placed.layout is None or placed.layout in has
        return bool(has) and own and float(placed.radii.mean()) >= wide_m

    found = [with_middle(spectra, body, placed) if may(placed) else placed for placed in several]
    return sorted(found, key=lambda placed: placed.charged)


def in_the_middle(reading: BodyReading) -> Middle:
    """What stands in the middle of the best layout's ring.

    Args:
        reading: on an enrolled body.
    """
    best, spectra = reading.layouts[0], reading.spectra
    cols = Columns.of(spectra, reading.body, best.batch)
    known = cols.values[:, :, : 1 + int(best.batch.terms[0])]
    solved = solve(spectra.data, known)
    wave = wave_in_the_middle(spectra, best)
    # (F, V): what the body and the ring do not hold of it.
    own = solve(wave, known).rest[0]
    size = (np.abs(own) ** 2).sum(axis=1)
    found = np.abs((own.conj() * spectra.data).sum(axis=1)) ** 2 / np.maximum(size, 1e-9 * spectra.views)
    psi = 2 * np.pi * np.arange(ASPECTS) / ASPECTS
    amplitudes, tilt = solved.amplitudes[0, :, 1:], float(best.batch.tilt[0])
    pattern = ((1 + np.cos(psi)) / 2) ** tilt * np.cos(np.arange(amplitudes.shape[1])[:, None] * psi)
    power = (np.abs(amplitudes @ pattern) ** 2).mean(axis=1)
    expected = float((power * size).sum())
    values = len(own) * max(spectra.views - 2 - int(best.batch.terms[0]), 1)
    error = float(solved.left[0]) * len(own) / values
    return Middle(float((found.sum() - error) / max(expected, 1e-300)), expected, error)
