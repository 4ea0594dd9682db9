"""What may have made the echo: the hypotheses that compete, and what a model of a body or object must offer.

Every hypothesis is judged by one number, the energy that it leaves of the same `Spectra`. Enrolled bodies and
objects take part by implementing `BodyModel` or `ObjectModel`; the reader knows nothing else of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.pulse_tail import Explained
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.stray import Stray
from tagid.tags.layouts.layout import Layout


class Kind(StrEnum):
    """The hypothesis that explains an echo best."""

    NO_TAG = "no_tag"
    """A body of revolution, or nothing, and no reflectors."""
    BARE = "bare"
    """Reflectors without a body that matters: ideal points at their nominal places."""
    ROUND = "round"
    """Reflectors on a body of revolution that nobody enrolled."""
    SHELL = "shell"
    """Reflectors on a thin elliptic shell that nobody enrolled, as a helmet has one."""
    BOX = "box"
    """Reflectors in or on a box of thin walls that nobody enrolled, as a carton or a plastic crate has."""
    BODY = "body"
    """Reflectors on an enrolled body."""
    OBJECT = "object"
    """An enrolled tagged object as a whole."""


@dataclass(frozen=True)
class Pose:
    """Where a body stands on the turntable.

    Attributes:
        centre_m: (x, y) of its own centre in the turntable's frame, m.
        turn_rad: its turn counter-clockwise about that centre, rad; 0 for a body of revolution.
    """

    centre_m: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0

    @property
    def centre(self) -> complex:
        """The centre as x + jy, m."""
        return complex(*self.centre_m)


@dataclass(frozen=True)
class Candidate:
    """A pose and the energy left there: the body alone, with one free amplitude per frequency."""

    pose: Pose
    left: float


@dataclass(frozen=True, eq=False)
class Seen:
    """A body where the turn may have been uneven, the pulse not that of the enrolment, or a round wall oval.

    Attributes:
        pose: of the body.
        spectra: the scans as the body's model has them: seen from where they were taken, without what the
            range window keeps of the other pulse's tail, and as if the wall were round.
        left: energy left, with what these deviations are charged.
    """

    pose: Pose
    spectra: Spectra
    left: float


class BodyModel(Protocol):
    """An untagged body. The reader adds the reflectors of a tag to it."""

    @property
    def name(self) -> str:
        """The name it was enrolled under; "" for a body of revolution."""
        ...

    @property
    def turns(self) -> bool:
        """Whether its echo depends on `Pose.turn_rad`."""
        ...

    @property
    def turning_share(self) -> float:
        """Energy of what depends on it over that of the whole echo; 0 for a body of revolution."""
        ...

    @property
    def slack_m(self) -> float:
        """Standard deviation of the reflectors' common centre about the body's, m; 0 where they are one."""
        ...

    def poses(self, spectra: Spectra) -> list[Candidate]:
        """The poses at which it explains the scans best, best first, one to four of them."""
        ...

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """(H, F, V) its echo at centres x + jy (H,), m, and turns (H,), rad; any common level per frequency.

        What is constant over the views need not be subtracted.
        """
        ...

    def seen(
        self,
        spectra: Spectra,
        pose: Pose,
        beside: NDArray[np.complex128] | None = None,
        variance: float = 0.0,
    ) -> Seen | None:
        """Where it stands near a pose, with what the scans deviate in; None where it tells nothing of that.

        Args:
            spectra: the scans.
            pose: start.
            beside: (F, C, V) echoes of reflectors, each with a free amplitude per frequency; None for none.
            variance: of one value of what all this leaves, where that is more than the noise.
        """
        ...


@dataclass(frozen=True, eq=False)
class ObjectMatch:
    """How well an enrolled object explains the scans.

    Attributes:
        pose: where it stands.
        spectra: the scans, seen from where it says that they were taken: the turn may have been uneven.
        explained: what the object explains of them, whatever the pulse.
        left: energy left, with what the errors of the angles are charged.
        noise_share: energy that the noise in the enrolled signature adds, as a share of the scans' noise.
        mirrored: it is the mirror image that stands there, as where the object turned the other way.
    """

    pose: Pose
    spectra: Spectra
    explained: Explained
    left: float
    noise_share: float
    mirrored: bool = False


class ObjectModel(Protocol):
    """A tagged object, enrolled as a whole."""

    @property
    def name(self) -> str:
        """The name it was enrolled under."""
        ...

    @property
    def layout(self) -> str | None:
        """The layout that this object stands for; None where it is its own identity."""
        ...

    def match(self, spectra: Spectra) -> ObjectMatch:
        """Its best pose."""
        ...

    def stray(self, found: ObjectMatch) -> Stray:
        """The strongest reflector in what it leaves in that pose."""
        ...

    def reflector_share(self, layout: Layout, bodies: Sequence[BodyModel]) -> float:
        """What a reflector of its tag returns at least, as a share of the object's turning echo."""
        ...


MOST_BODIES = 3
"""Enrolled bodies on which layouts are fitted in one capture. Below a loud tag the right one is not always
among the first."""
FAR_BODY = 2.0
"""A body that alone leaves so many times what the best one leaves is not what stands there: a tag adds the
same to both. So does noise, which is not counted,"""
CHANCE_SIGMAS = 3.0
"""beside so many standard deviations of its energy."""


def plausible(spectra: Spectra, bodies: Sequence[BodyModel]) -> list[BodyModel]:
    """The enrolled bodies on which a tag may be, the best first.

    One that looks the same from all sides is left out: it is a body of revolution, which is fitted anyway,
    and its echo does not say which one it is.
    """
    found = [(body.poses(spectra)[0].left, i) for i, body in enumerate(bodies) if body.turns]
    least = min((left for left, _ in found), default=0.0)
    noise = spectra.noise_energy
    most = noise + FAR_BODY * max(least - noise, 0.0) + CHANCE_SIGMAS * spectra.noise_spread
    near = [i for left, i in sorted(found) if left <= most]
    return [bodies[i] for i in near[:MOST_BODIES]]


@dataclass(frozen=True)
class Enrolled:
    """Enrolled bodies and objects, beside the layouts.

    Attributes:
        bodies, objects: the models.
        wavenumbers: (F,) frequencies at which they are known, as kappa, rad/m; None where there are none.
    """

    bodies: tuple[BodyModel, ...] = ()
    objects: tuple[ObjectModel, ...] = ()
    wavenumbers: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Explanation:
    """One hypothesis after its fit, as the answer reports it.

    Attributes:
        kind: see `Kind`.
        name: of the enrolled body or object; "" otherwise.
        layout: the layout that it would name; None where it names none.
        left: share of the moving echo above noise that it leaves unexplained, 0..1.
        beyond_body: the same as a share of what the body leaves; None without reflectors.
        pose: the body's.
        rotation_deg: the layout's turn, counter-clockwise; None without one.
        radius_m: mean apparent radius of the reflectors about the body's centre, m; None without reflectors.
    """

    kind: Kind
    name: str
    layout: str | None
    left: float
    beyond_body: float | None
    pose: Pose
    rotation_deg: float | None = None
    radius_m: float | None = None
