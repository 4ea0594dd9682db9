"""Reflectors beside an enrolled body that hardly changes the wave: points, once its echo is taken out.

A box of thin plastic has an echo of its own, but before and behind it a reflector looks the same as alone. A
pattern that is free in frequency and angle has three to seven amplitudes where points and their double bounce
have two, so that other arrangements on the body explain such a tag about as well as its layout, above all
from few views. Points do not: what is left of the scans without the body is read as a tag without one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.reflectors_fit import POINTS, Fitter, Priors
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.subtract import scans_without


@dataclass(frozen=True)
class TransparentDecision:
    """What bears out a name that points have beside an enrolled body.

    Attributes:
        unexplained: share of the tag's echo that its points may leave, beyond the noise,
        lead: and their least lead over points elsewhere.
        behind: lead by which other arrangements on the body, with free patterns, may be ahead of the layout:
            it must be the nearest there, too. Of 25 right names it leads by -0.06 or more in 22, of a foreign
            tag in a mug with a handle the other arrangement was ahead by 0.23.
    """

    unexplained: float = 0.10
    lead: float = 0.0
    behind: float = 0.12

    def bears_out(self, points: PointReading, reading: BodyReading) -> bool:
        """Whether points may name their best layout, which the reading on the body did not."""
        explained = points.unexplained <= self.unexplained and points.lead >= self.lead
        same = reading.layouts[0].layout == points.layouts[0].layout
        return explained and same and reading.lead >= -self.behind


def without_transparent(
    scans: BasebandScans, spectra: Spectra, reading: BodyReading, priors: Priors
) -> BasebandScans:
    """The scans without an enrolled body's echo, which is fitted together with points for the best layout.

    Args:
        scans: made without the matched filter.
        spectra: the same at the frequencies of the signature.
        reading: on the enrolled body.
        priors: of centre and radius.
    """
    found = reading.layouts[0].batch
    at = found.at.copy()
    at[0, 2] = 0.0
    points = replace(found, at=at, terms=0 * found.terms + POINTS.terms, tilt=0 * found.tilt + POINTS.tilt)
    variance = max(spectra.noise, 1e-12 * reading.body_left)
    variance += priors.model_error * reading.body_left / spectra.data.size
    pose = found.at[0, 3:6].copy()
    placed, _ = Fitter(spectra, reading.body, priors, variance, pose).fitted(points)
    return scans_without(scans, reading.body, placed)
