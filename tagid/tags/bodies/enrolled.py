"""Enrolled bodies and objects as hypotheses of the reader.

A body takes part as what stands under a tag, with any layout on it; an object, enrolled with its tag, as a
whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Enrolled, ObjectMatch, Pose, Seen
from tagid.tags.bodies.posing import Match, PoseSearch, match, refine
from tagid.tags.bodies.pulse_tail import explained
from tagid.tags.bodies.signature import (
    SAME_WAVENUMBER,
    Signature,
    angular,
    between,
    echo,
    near_field,
    same_wavenumbers,
)
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.steadying import steadied
from tagid.tags.bodies.stray import Stray, strongest_stray
from tagid.tags.bodies.tag_share import reflector_share
from tagid.tags.layouts.layout import Layout

FREQUENCY_STEP_HZ = 0.2e9
"""Spacing of the frequencies of signatures: the range window of `Spectra` is 0.65 m wide, so spectra
vary over c / (2 x 0.65 m) = 0.23 GHz. The frequencies are multiples of it, whatever pulse and window are."""
SLACK_M = 5e-3
"""A tag's ring is centred on the body to this, standard deviation a coordinate; the centre of a signature is
that of its first capture."""
BEYOND_M = 0.02
"""A reflector that the enrolled object lacks is searched so far beyond the circle that holds its echo, m."""
ROUND_NOISE_SHARE = 0.5
"""A signature whose turning echo is noise to this share is that of a body of revolution."""


def signature_wavenumbers(center_frequency_hz: float, bandwidth_hz: float) -> NDArray[np.float64]:
    """(F,) kappa of the multiples of FREQUENCY_STEP_HZ inside a band, rad/m.

    >>> signature_wavenumbers(3.95e9, 1.7e9).size
    9
    """
    low = (center_frequency_hz - bandwidth_hz / 2) / FREQUENCY_STEP_HZ
    high = (center_frequency_hz + bandwidth_hz / 2) / FREQUENCY_STEP_HZ
    steps = np.arange(np.ceil(low - 1e-6), np.floor(high + 1e-6) + 1)
    return np.asarray(4 * np.pi / SPEED_OF_LIGHT * FREQUENCY_STEP_HZ * steps)


class Searches:
    """The coarse search of the capture at hand, shared by all signatures that are looked for in it."""

    def __init__(self, order: int) -> None:
        self._order = order
        self._spectra: Spectra | None = None
        self._search: PoseSearch | None = None
        self._poses: dict[Signature, list[Candidate]] = {}

    def of(self, spectra: Spectra) -> PoseSearch:
        """The search in these spectra; the last one is kept."""
        if self._search is None or self._spectra is not spectra:
            self._spectra, self._search = spectra, PoseSearch(spectra, self._order)
            self._poses = {}
        return self._search

    def poses(self, spectra: Spectra, signature: Signature, starts: int) -> list[Candidate]:
        """The refined poses of a signature, best first, kept for these spectra."""
        search = self.of(spectra)
        found = self._poses.get(signature)
        if found is None:
            found = []
            for start in search.candidates(signature, starts):
                near = refine(spectra, signature, start, split=True, iterations=5)
                end = refine(spectra, signature, near.pose)
                found.append(Candidate(end.pose, end.left))
            found.sort(key=lambda one: one.left)
            self._poses[signature] = found
        return found


@dataclass(frozen=True, eq=False)
class EnrolledBody:
    """An enrolled untagged body (a `BodyModel`).

    Attributes:
        signature: of the body.
        searches: shared between models.
        starts: poses of the coarse search that are refined.
    """

    signature: Signature
    searches: Searches
    starts: int = 3

    @property
    def name(self) -> str:
        """The name it was enrolled under."""
        return self.signature.name

    @property
    def turns(self) -> bool:
        """Whether its echo depends on its turn."""
        return self.signature.noise_share < ROUND_NOISE_SHARE

    @property
    def turning_share(self) -> float:
        """Energy of what depends on it over that of the whole echo."""
        return self.signature.turning_share

    @property
    def slack_m(self) -> float:
        """Standard deviation of a tag's centre about the body's, m."""
        return SLACK_M

    def poses(self, spectra: Spectra) -> list[Candidate]:
        """The poses at which it explains the scans best, best first."""
        return self.searches.poses(spectra, self.signature, self.starts)

    def seen(
        self,
        spectra: Spectra,
        pose: Pose,
        beside: NDArray[np.complex128] | None = None,
        variance: float = 0.0,
    ) -> Seen | None:
        """Where it stands near a pose, on a turntable that may turn unevenly.

        None for a body of revolution, and at other frequencies than those of its signature. That the pulse
        has another tail is believed where that pays for an amplitude more at every frequency.
        """
        own = self.signature
        if not self.turns or not same_wavenumbers(spectra.wavenumbers, own.wavenumbers):
            return None
        found = steadied(spectra, own, pose, beside=beside, variance=variance)
        other = steadied(spectra, own, pose, beside=beside, variance=variance, tail=True)
        return other if found.left - other.left > spectra.amplitude_cost else found

    def _harmonics(self, wavenumbers: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(F, 2 M + 1) of the signature, those of its own frequencies as they are."""
        known = self.signature.wavenumbers
        away = np.abs(known[:, None] - wavenumbers)
        # The reader's coarse steps use some of the frequencies only.
        rows = away.argmin(axis=0)
        if away.min(axis=0).max() < SAME_WAVENUMBER:
            return np.asarray(self.signature.harmonics[rows])
        return between(self.signature.harmonics, known, wavenumbers)

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """(H, F, V) its echo at centres x + jy (H,), m, and turns (H,), rad."""
        order = self.signature.order
        near = near_field(spectra.wavenumbers, order, spectra.distance_m)
        weights = self._harmonics(spectra.wavenumbers) * near
        across = spectra.antenna - np.asarray(centres)[:, None]
        rho = np.abs(across)
        carrier = spectra.waves(rho) * (spectra.distance_m / rho) ** 2
        basis = angular(np.angle(across) - np.asarray(turns)[:, None], order)
        pattern = np.einsum("fm,hvm->hfv", weights, basis, optimize=True)
        return np.ascontiguousarray(np.moveaxis(carrier, 0, 1) * pattern)


@dataclass(frozen=True, eq=False)
class EnrolledObject:
    """An enrolled tagged object (an `ObjectModel`).

    Attributes:
        signature: of the object with its tag.
        searches: shared between models.
        either_way: try its mirror image too: the direction of the turn is not known.
    """

    signature: Signature
    searches: Searches
    either_way: bool = False

    @property
    def name(self) -> str:
        """The name it was enrolled under, which is the identity that it stands for."""
        return self.signature.name

    @property
    def layout(self) -> str | None:
        """Objects are enrolled under the name of their identity."""
        return self.signature.name

    def match(self, spectra: Spectra) -> ObjectMatch:
        """Its best pose, on a turntable that may turn unevenly."""
        found = self.placed(spectra)
        seen = self._seen(found.mirrored)
        best = steadied(spectra, seen, found.pose)
        known = explained(best.spectra, centred(echo(best.spectra, seen, best.pose)))
        left, noise = known.left + best.charged, self.noise_share(spectra)
        return ObjectMatch(best.pose, best.spectra, known, left, noise, found.mirrored)

    def stray(self, found: ObjectMatch) -> Stray:
        """The strongest reflector in what it leaves in that pose."""
        reach = self.signature.radius_m + BEYOND_M
        return strongest_stray(found.spectra, found.explained, found.pose.centre, reach)

    def reflector_share(self, layout: Layout, bodies: Sequence[BodyModel]) -> float:
        """What a reflector of its tag returns at least, as a share of the object's turning echo."""
        return reflector_share(self.signature, layout, bodies)

    def _seen(self, mirrored: bool) -> Signature:
        return self.signature.mirrored() if mirrored else self.signature

    def placed(self, spectra: Spectra) -> Match:
        """Its best pose, and whether it is that of the mirror image."""
        return match(spectra, self.signature, self.searches.of(spectra), either_way=self.either_way)

    def noise_share(self, spectra: Spectra) -> float:
        """Energy that the noise of the signature adds to what it leaves, over that of the noise of the scans.

        An enrolment from n captures of V_i views at the same level has (2 M + 1) / sum V_i.
        """
        echo_energy = max(spectra.energy - spectra.noise_energy, 0.0)
        return float(self.signature.noise_share * echo_energy / max(spectra.noise_energy, 1e-300))


def hypotheses(
    signatures: Sequence[Signature],
    wavenumbers: NDArray[np.float64],
    *,
    direction_known: bool = True,
) -> Enrolled:
    """Enrolled bodies and objects as hypotheses of the reader.

    Args:
        signatures: enrolled ones; those of another band than the capture's take no part.
        wavenumbers: `signature_wavenumbers` of the capture's band.
        direction_known: whether the direction of the turn is; else bodies and objects stand both ways.
    """
    signatures = [one for one in signatures if same_wavenumbers(one.wavenumbers, wavenumbers)]
    if not signatures:
        return Enrolled()
    searches = Searches(max(one.order for one in signatures))
    bodies = [EnrolledBody(one, searches) for one in signatures if one.kind == "body"]
    if not direction_known:
        bodies += [EnrolledBody(body.signature.mirrored(), searches) for body in bodies if body.turns]
    objects = [
        EnrolledObject(one, searches, not direction_known) for one in signatures if one.kind == "object"
    ]
    return Enrolled(tuple(bodies), tuple(objects), wavenumbers)
