"""A pair on a thin plastic wall, which hardly returns anything but delays the reflector behind it.

On a bottle of 2 mm a reflector behind the body seems 2 to 4 mm farther away. To points an enrolled pair has
moved then, and another one may have the spacing of an enrolled one. Points leave 2 to 10 % of the echo of a
pair on such a wall, and nothing of it is left beside a wall of known waves; of a pair without a body it
leaves no less than points do. Where the wall shows so, the reading beside it decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.cylinder_patterns import THIN
from tagid.tags.bodies.decide import decide_on_body
from tagid.tags.bodies.hypothesis import Kind, Pose
from tagid.tags.bodies.points import PointReading, tapered_left
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.promise import bound_on_body, kept
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import hypothesis_on, on_body, placement_of
from tagid.tags.verdicts.verdict import Code, Verdict

ASKED = (Code.DISPLACED, Code.ELSEWHERE, Code.EXTRA, Code.MISSING, Code.OTHER)
"""Refusals without a body that such a wall may be the cause of."""
_AMPLITUDES, _SPREADS = 3, 2.0
"""Amplitudes per frequency beside a wall; standard deviations of the noise's energy."""


def borne_out_by_thin_wall(
    reading: Reading,
    points: PointReading,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> Reading | None:
    """The reading of a pair that a thin wall moves from its places; None where it bears out none.

    Args:
        reading: as settled between the other hypotheses, without a name.
        points: fit of points with double bounce.
        spectra: the scans.
        layouts: the enrolled ones.
        settings: of the contest.
    """
    found = pair_on_thin_wall(reading, points, spectra, layouts, settings)
    if found is None:
        return None
    bound = bound_on_body(found, settings.delayed_tests, settings.calibration(), settings.false_accept)
    if kept(bound, Verdict("identified")).status != "identified":
        return None
    hypotheses = tuple(sorted((*reading.hypotheses, hypothesis_on(found)), key=lambda one: one.left))
    return replace(on_body(reading, found, layouts, bound), hypotheses=hypotheses)


def pair_on_thin_wall(
    reading: Reading,
    points: PointReading,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> BodyReading | None:
    """The nearest pair beside a thin wall where that explains the whole echo; None where it does not.

    Args:
        reading: one that names nothing.
        points, spectra, layouts, settings: as of `borne_out_by_thin_wall`.
    """
    own = points.layouts[0]
    near = points.least <= settings.points.unexplained and points.unexplained <= settings.bare.unexplained
    # Of 18 views a wall explains other spacings as well: 3 of 2,000 bare pairs 1 to 4 mm wider were named.
    rich = spectra.views >= settings.body.through_views
    asked = reading.status == "unknown" and reading.kind is Kind.BARE and reading.code in ASKED
    if not (asked and near and rich) or len(own.places) != 2:
        return None
    left = min(one.left for one in (own, points.free, *points.others))
    margin = settings.delayed_nats * spectra.noise + settings.delayed_share * points.tag
    found = _beside_thin_wall(reading, points, spectra, layouts, settings, left - margin)
    if found is None:
        return None
    found = found.against(points)
    best = found.layouts[0]
    # What neither explains is of something else.
    whole = best.left - spectra.noise_energy <= settings.delayed_rest * (left - spectra.noise_energy)
    passed = decide_on_body(found, settings.delayed_tests).status == "identified"
    return found if best.layout == own.layout and passed and whole else None


def undelayed(
    reading: Reading,
    points: PointReading | None,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
) -> Reading:
    """A pair's name without a body, taken back where beside a thin wall other reflectors are as likely.

    Args:
        reading: as settled between the other hypotheses, with a name or without one.
        points: fit of points with double bounce; None where none was made.
        spectra, layouts, settings: as of `borne_out_by_thin_wall`.
    """
    if points is None or reading.status != "identified" or reading.kind is not Kind.BARE:
        return reading
    own = next((placed for placed in points.layouts if placed.layout == reading.layout), None)
    # Reflectors that shine outward only are no points, and their name does not rest on them.
    opaque = reading.evidence.outward > settings.outward
    if own is None or len(own.places) != 2 or opaque:
        return reading
    layout = next(one for one in layouts if one.name == reading.layout)
    left = min(own.left, tapered_left(spectra, own, placement_of(layout, own).centre))
    margin = settings.undone_nats * spectra.noise + settings.undone_share * points.tag
    found = _beside_thin_wall(reading, points, spectra, layouts, settings, left - margin)
    if found is None:
        return reading
    if found.layouts[0].layout == reading.layout and found.lead >= settings.decision.lead:
        return reading
    reason = f"beside a thin wall, which explains the echo better, others are as likely as {reading.layout}"
    return replace(reading.refused(Code.OTHER, reason), body=found)


def _beside_thin_wall(
    reading: Reading,
    points: PointReading,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: ContestSettings,
    most: float,
) -> BodyReading | None:
    """The best layout beside a thin wall about the middle of the points.

    Args:
        reading, points, spectra, layouts, settings: as of `borne_out_by_thin_wall`.
        most: energy that it, or another arrangement there, may leave at most; None is returned otherwise.
    """
    # An arrangement beside a wall leaves the noise that it does not happen to fit.
    rest = 1 - _AMPLITUDES / max(spectra.views - 1, _AMPLITUDES)
    if spectra.noise <= 0 or most <= rest * spectra.noise_energy - _SPREADS * spectra.noise_spread:
        return None
    from tagid.tags.bodies.cylinder_reader import read_on_cylinder
    from tagid.tags.bodies.on_body import read_on_body

    first = reading.body
    if first is None or first.body.name or first.wall is not None:
        hints = [complex(*reading.centre_m)]
        first = read_on_body(spectra, layouts, settings.body.body, settings.body, hints)
    if first is None:
        return None
    middle = complex(points.free.places.mean())
    about = replace(first, pose=Pose((middle.real, middle.imag)))
    found = read_on_cylinder(spectra, layouts, about, settings.body, THIN)
    if found is None:
        return None
    others = min((placed.charged for placed in found.others), default=inf)
    return found if min(found.layouts[0].left, others) < most else None
