"""Names without a body: what points with double bounce say of them, and which of them stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from tagid.tags.bodies.arrangement import difference_deg, gaps_deg, layout_gaps_deg
from tagid.tags.bodies.calibration import Basis
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.points import Place, PointReading, PointSettings, read_points
from tagid.tags.bodies.reflectors_fit import FEWEST_TERMS
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.bare_checks import checked
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.delayed import undelayed
from tagid.tags.matching.promise import kept
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import as_points
from tagid.tags.verdicts.verdict import Code, Verdict


@dataclass(frozen=True, eq=False)
class Alone:
    """A name without a body that every check leaves.

    Attributes:
        reading: with the name and its bound.
        points: fit of points with double bounce.
    """

    reading: Reading
    points: PointReading


def named_alone(
    bare: Reading, spectra: Spectra, layouts: Sequence[Layout], settings: ContestSettings
) -> Alone | None:
    """The name that scans give without a body; None where they give none.

    Args:
        bare: reading of the scans without a body.
        spectra: the same scans.
        layouts: the enrolled ones.
        settings: of the contest.
    """
    if bare.code is Code.NO_ECHO:
        return None
    points = points_of(bare, spectra, layouts, settings.points)
    named = without_body(in_place(bare, points, settings.points), points, layouts, settings)
    if named is None:
        return None
    # Reflectors that shine outward only are never named without a body.
    named = checked(named, points, spectra, layouts, settings.bare, opaque=False)
    named = undisputed(named, points, spectra, layouts, settings)
    named = undelayed(named, points, spectra, layouts, settings)
    named = promised(named, points, spectra.views, settings)
    return Alone(named, points) if named.status == "identified" else None


SILENT_SIGMAS = 3.0
"""Moving echoes are there where they exceed what noise may have by so many standard deviations."""


def is_silent(bare: Reading, spectra: Spectra) -> bool:
    """Whether nothing moves: no point stands out of the noise, and neither does the energy of all of it.

    What a wall makes of reflectors spreads over the views so that none of them looks like a point.
    """
    most = spectra.noise_energy + SILENT_SIGMAS * spectra.noise_doubt
    return bare.code is Code.NO_ECHO and spectra.energy <= most


def points_of(
    bare: Reading, spectra: Spectra, layouts: Sequence[Layout], settings: PointSettings
) -> PointReading:
    """Points with double bounce near where the bare reading found something."""
    by_name = {layout.name: layout for layout in layouts}
    places = [Place(by_name[s.name], float(np.deg2rad(s.rotation_deg)), s.centre_m) for s in bare.scores]
    found = np.array([complex(r.x_m, r.y_m) for r in bare.reflectors], dtype=np.complex128)
    return read_points(spectra, places, found, settings)


def in_place(bare: Reading, points: PointReading, settings: PointSettings) -> Reading:
    """The bare reading, its name taken back where points with double bounce find the reflectors elsewhere."""
    if bare.layout != points.layouts[0].layout or not points.displaced(settings):
        return bare
    off = points.displaced_m * 1e3
    return bare.refused(Code.DISPLACED, f"reflectors lie {off:.1f} mm from the nearest layout's")


def without_body(
    bare: Reading, points: PointReading | None, layouts: Sequence[Layout], settings: ContestSettings
) -> Reading | None:
    """The reading where no body need take part; None where one may."""
    if bare.evidence.outward > settings.outward:
        return None
    if points is not None and pointed(bare, points, settings):
        return as_points(bare, points, layouts)
    named = bare.status in ("identified", "ambiguous")
    return bare if named and bare.evidence.share >= settings.explained else None


def pointed(bare: Reading, points: PointReading, settings: ContestSettings) -> bool:
    """Whether points name a layout that nothing in the bare reading speaks against.

    With amplitudes that are free in frequency and few views a pair is also three reflectors twice as far
    apart: where the bare reading finds another layout nearest, its refusal is no ground to name this one.
    Nor is it where a reflector has no constant amplitude: free ones take up the echo of a wall.
    """
    doubted = bare.status == "ambiguous" or bare.code in (Code.HIDDEN, Code.NO_ECHO)
    doubted = doubted or bare.evidence.absent > 0
    other = bare.layout is None and bare.nearest != points.layouts[0].layout
    return points.passes(settings.points) and not doubted and not other


BODY_LEAVES = 0.6
"""No arrangement on a body leaves less than this share of the noise: it has up to 6 of at least 17 amplitudes
per frequency."""


def undisputed(
    reading: Reading,
    points: PointReading | None,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> Reading:
    """A name without a body, taken back where other reflectors on a round body explain the echo better.

    A weak echo is explained to the noise by many arrangements of points; then it counts which explains most.
    Two reflectors on a thin plastic wall seem farther apart than they are: to points they are another pair.
    Reflectors that are hidden in some views are explained by their layout on a body, which counts for it.
    Where points leave little beyond the noise, and what the fewest amplitudes on a body are charged, no body
    is tried.
    """
    if reading.status != "identified" or reading.kind is not Kind.BARE or points is None:
        return reading
    own = next((placed.left for placed in points.layouts if placed.layout == reading.layout), inf)
    pairs = [one.name for one in layouts if len(one.positions) == 2]
    share = settings.disputed_share if reading.layout in pairs else settings.points.unexplained
    margin = settings.disputed_nats * spectra.noise + share * points.tag
    least = BODY_LEAVES * spectra.noise_energy + (FEWEST_TERMS - 1) * spectra.amplitude_cost
    if spectra.noise <= 0 or own - least <= margin:
        return reading
    body = reading.body
    if body is None or body.body.name:
        from tagid.tags.bodies.on_body import read_on_body

        body = read_on_body(spectra, layouts, settings.body.body, settings.body, [complex(*reading.centre_m)])
    if body is None:
        return reading
    wanted = layout_gaps_deg(next(one for one in layouts if one.name == reading.layout))
    alike, others = [own], [inf]
    for placed in (*body.layouts, *body.others, *([body.free] if body.free else [])):
        same = difference_deg(gaps_deg(placed.angles), wanted) <= settings.body.other_deg
        (alike if same else others).append(placed.charged)
    if min(others) >= min(alike) - margin:
        return reading
    refused = reading.refused(
        Code.OTHER,
        f"other reflectors on a round body explain the echo better than {reading.layout} without one",
    )
    return replace(refused, body=body)


def promised(reading: Reading, points: PointReading | None, views: int, settings: ContestSettings) -> Reading:
    """A name without a body with the bound that holds for it, taken back where the setting asks for more.

    Args:
        reading: with a name or without one.
        points: what the scans show without a body; None where none were fitted: nothing is promised then.
        views: of the scans.
        settings: of the contest.
    """
    if reading.status != "identified" or reading.kind is not Kind.BARE or points is None:
        return reading
    bound = settings.calibration().bound(points.lead, views, points.snr_db, settings.false_accept, Basis.BARE)
    verdict = kept(bound, Verdict("identified"))
    promise = replace(reading, bound=bound)
    return promise if verdict.status == "identified" else promise.refused(verdict.code, verdict.reason)
