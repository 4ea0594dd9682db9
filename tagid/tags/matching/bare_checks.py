"""What may take back a name without a body: another centre, better points, or a wall that is not round.

Two or three points have few properties by which they can be told from an echo that is not theirs. Each check
here holds a simpler explanation against them that has as many free amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tagid.tags.bodies.decide import FARTHEST_CENTRE_M
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.symmetric import symmetric_left
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code


@dataclass(frozen=True)
class BareDecision:
    """Checks of a name without a body; each can only take it away.

    Attributes:
        centre_m: largest distance of a pair's centre from the rotation axis. Two bare reflectors have nothing
            but their spacing and their place: those of another angle on a ring of another radius are an
            enrolled pair about a centre that is not the object's.
        unexplained: where points elsewhere explain more than the layout does, the largest share of the echo
            that the layout may leave beyond the noise. Of 248 bare tags down to 0 dB two leave 10 and 14 %,
            the others less,
        uneven_lead, uneven_unexplained: and where something may hide a reflector in some views, where the
            layout leads by less and leaves more. Reflectors of constant brightness lead by -0.2 and more of
            240 such tags, and leave up to 6 %; two false names led by -0.4 and -0.5 and left 48 and 67 %.
        wall: an oval wall without reflectors, with as many amplitudes per frequency as points and their
            double bounce have, leaves more than a layout of twofold symmetry by this share of the echo: bare
            tags of 12 to 72 views by 21 % or more, ovals, shells and cups by at most 8 %.
    """

    centre_m: float = FARTHEST_CENTRE_M
    unexplained: float = 0.15
    uneven_lead: float = -0.25
    uneven_unexplained: float = 0.3
    wall: float = 0.15


AMPLITUDES = 2
"""Per frequency, of points with their double bounce."""


def checked(
    reading: Reading,
    points: PointReading | None,
    spectra: Spectra,
    layouts: Sequence[Layout],
    settings: BareDecision,
    *,
    opaque: bool,
) -> Reading:
    """The reading, its name taken back where a check refuses it; other readings as they are.

    Args:
        reading: as settled between the hypotheses.
        points: fit of points with double bounce; None where none was made.
        spectra: the scans.
        layouts: the enrolled ones.
        settings: see there.
        opaque: the reflectors shine outward only, as before something that hides them: they are no points,
            and their name does not rest on the fit of points.
    """
    if reading.status != "identified" or reading.kind is not Kind.BARE:
        return reading
    layout = next(one for one in layouts if one.name == reading.layout)
    centre = complex(*reading.centre_m)
    if len(layout.positions) == 2 and abs(centre) > settings.centre_m:
        # No number: the search ends little farther out.
        off = f"its centre lies more than {settings.centre_m * 1e3:.0f} mm off the axis"
        return reading.refused(Code.OFF_CENTRE, f"a pair in the spacing of {layout.name}, but {off}")
    own = next((p for p in points.layouts if p.layout == layout.name), None) if points is not None else None
    if points is None or own is None or opaque:
        return reading
    # Points of constant brightness say less of reflectors that something hides in some views.
    even = reading.evidence.uneven_nats <= 0
    lead = 0.0 if even else settings.uneven_lead
    most = settings.unexplained if even else settings.uneven_unexplained
    if points.lead < lead and points.unexplained > most:
        left = f"which leaves {points.unexplained:.0%}"
        return reading.refused(
            Code.ELSEWHERE, f"points elsewhere explain the echo better than {layout.name}, {left}"
        )
    if layout.symmetry == 2 and points.tag > 0:
        wall = symmetric_left(spectra, layout.symmetry, AMPLITUDES, (centre,))
        if wall - own.left < settings.wall * points.tag:
            return reading.refused(
                Code.BODY,
                f"an oval body without reflectors explains the echo about as well as {layout.name}",
            )
    return reading
