"""Signatures: the echo of a body, or of a tagged object, as angular harmonics at every frequency.

An object turned by g with its centre at c (both in the turntable's frame) is modelled at frequency f and view
v as

    Y[f, v] = B(f) + G(f) b(f, v) sum_m S_m(f) exp(-j m^2 / (2 kappa d)) exp(j m (phi_v - g))
    b(f, v) = exp(-j kappa (rho_v - d)) (d / rho_v)^2,   kappa = 4 pi f / c0

with rho_v and phi_v the distance and azimuth of the antenna seen from c, and d the axis distance. B is the
static room. G is free at each frequency: another pulse, level or range offset changes nothing else. The
factor in m^2 is the near field: the harmonic m comes, by stationary phase, from where m = -kappa r sin(psi),
and there the spherical wave is late by r^2 sin^2(psi) / (2 d), which is a phase of m^2 / (2 kappa d). It
carries a signature from one axis distance to another. What it neglects is of the order r / d in amplitude,
so enroll at the distance at which you read.

Sampling: a point at radius r answers exp(j kappa r cos(psi)) = sum_m j^m J_m(kappa r) exp(j m psi), and J_m
falls off faster than exponentially beyond |m| = kappa r; `order_of` says where to stop. The field of sources
within a radius has about that many degrees of freedom whatever they are (Bucci and Franceschetti, "On the
degrees of freedom of scattered fields", IEEE Transactions on Antennas and Propagation 37(7), 1989).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import is_name

MIN_RADIUS_M, MAX_RADIUS_M = 0.02, 0.16
"""Of what can be enrolled. A helmet with its reflectors has 0.12 m."""
MAX_FREQUENCIES, MAX_ORDER = 32, 64
"""Bounds of a stored signature: larger ones are not believed."""
MAX_LABEL = 200
SAME_WAVENUMBER = 4 * np.pi * 1e6 / SPEED_OF_LIGHT
"""Frequencies nearer than 1 MHz are the same, rad/m."""
FREQUENCY_STEP_HZ = 0.2e9
"""Spacing of the frequencies of signatures: the range window of `Spectra` is 0.65 m wide, so spectra
vary over c / (2 x 0.65 m) = 0.23 GHz. The frequencies are multiples of it, whatever pulse and window are."""
SignatureKind = Literal["body", "object"]
KINDS = ("body", "object")


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


@dataclass(frozen=True, eq=False)
class Signature:
    """The echo of one body or tagged object.

    Attributes:
        name: of the body, or of the identity that the tagged object stands for.
        kind: "body" (untagged) or "object" (with its tag).
        wavenumbers: (F,) kappa = 4 pi f / c0, rad/m, ascending.
        harmonics: (F, 2 M + 1) complex128, S_m(f) for m = -M..M; zero where |m| exceeds `order_of`.
        noise: (F,) variance of the noise of one harmonic, in the units of |S|^2.
        radius_m: of the smallest circle about the centre that holds the echo, m.
        distance_m: antenna to axis at the enrollment, m.
        height_m: antenna above the object's plane at the enrollment, m.
        model_error: share of the turning echo that the captures leave unexplained beyond noise.
        captures: number of captures it was estimated from.
        label: for people.

    Raises UsageError where name or label cannot be, DataError where another field is impossible.
    """

    name: str
    kind: SignatureKind
    wavenumbers: NDArray[np.float64]
    harmonics: NDArray[np.complex128]
    noise: NDArray[np.float64]
    radius_m: float
    distance_m: float
    height_m: float = 0.0
    model_error: float = 0.0
    captures: int = 0
    label: str = ""

    def __post_init__(self) -> None:
        shape = self.harmonics.shape
        count = len(self.wavenumbers) if self.wavenumbers.ndim == 1 else 0
        wrong = ""
        if not is_name(self.name):
            raise UsageError(
                f"the name {str(self.name)[:80]!r} is not valid",
                "Use 1 to 64 of a-z, 0-9, dot, dash and underscore; begin and end with a letter or digit.",
            )
        if len(self.label) > MAX_LABEL or not self.label.isprintable():
            raise UsageError(
                f"the label of {self.name} is not a line of up to {MAX_LABEL} characters", "Shorten it."
            )
        if self.kind not in KINDS:
            wrong = f"kind {str(self.kind)[:20]!r}"
        elif not 2 <= count <= MAX_FREQUENCIES or self.noise.shape != (count,):
            wrong = f"{count} frequencies"
        elif (
            len(shape) != 2
            or shape[0] != count
            or not 3 <= shape[1] <= 2 * MAX_ORDER + 1
            or shape[1] % 2 == 0
        ):
            wrong = f"harmonics of shape {shape}"
        elif not all(np.isfinite(a).all() for a in (self.wavenumbers, self.harmonics, self.noise)):
            wrong = "values that are not finite"
        elif not (
            self.wavenumbers[0] > 1.0 and (np.diff(self.wavenumbers) > 0).all() and self.wavenumbers[-1] < 2e3
        ):
            wrong = "impossible frequencies"
        elif not np.any(self.harmonics) or (self.noise < 0).any():
            wrong = "no echo or negative noise"
        elif not MIN_RADIUS_M <= self.radius_m <= MAX_RADIUS_M:
            wrong = f"a radius of {self.radius_m:g} m"
        elif not (0.05 <= self.distance_m <= 100 and abs(self.height_m) <= 10):
            wrong = f"an axis distance of {self.distance_m:g} m at {self.height_m:g} m height"
        elif not (0 <= self.model_error <= 1 and 0 <= self.captures <= 1000):
            wrong = "an impossible error or number of captures"
        if wrong:
            raise DataError(
                f"the signature of {str(self.name)[:80]!r} has {wrong}", "Enroll it again from captures."
            )

    @property
    def order(self) -> int:
        """M, the largest harmonic."""
        return int(self.harmonics.shape[1]) // 2

    @property
    def frequencies_hz(self) -> NDArray[np.float64]:
        """(F,) Hz."""
        return np.asarray(self.wavenumbers * SPEED_OF_LIGHT / (4 * np.pi))

    @property
    def turning(self) -> NDArray[np.complex128]:
        """(F, 2 M + 1) harmonics without m = 0, which does not depend on aspect."""
        out = self.harmonics.copy()
        out[:, self.order] = 0
        return out

    @property
    def noise_share(self) -> float:
        """Energy of the noise in the harmonics over that of the turning echo, at most 1."""
        mask = order_mask(self.wavenumbers, self.radius_m, self.order)
        mask[:, self.order] = False
        noise = float(np.sum(self.noise[:, None] * mask))
        return min(noise / max(float(np.sum(np.abs(self.turning) ** 2)), 1e-300), 1.0)

    @property
    def turning_share(self) -> float:
        """Energy of the turning echo over that of the whole, noise subtracted: 0 for a body of revolution."""
        whole = float(np.sum(np.abs(self.harmonics) ** 2))
        turning = float(np.sum(np.abs(self.turning) ** 2)) * (1 - self.noise_share)
        return turning / max(whole, 1e-300)


def order_of(wavenumber: float, radius_m: float) -> int:
    """Largest harmonic of an object of that radius at two-way wavenumber kappa (rad/m).

    x + x^(1/3) with x = kappa r; beyond it a point on the rim keeps about 1 % of its energy. A can with its
    tag (rim at 0.055 m) has 13 at 4.8 GHz, a helmet (0.115 m) 26.

    >>> order_of(201.2, 0.055), order_of(201.2, 0.115)
    (13, 26)
    """
    x = wavenumber * radius_m
    return int(np.ceil(x + x ** (1 / 3) - 0.5))


def order_mask(wavenumbers: NDArray[np.float64], radius_m: float, order: int) -> NDArray[np.bool_]:
    """(F, 2 order + 1) whether a harmonic belongs to an object of that radius."""
    limit = np.array([order_of(float(k), radius_m) for k in wavenumbers])
    return np.asarray(np.abs(np.arange(-order, order + 1))[None] <= limit[:, None])


class Standpoint:
    """How the antenna positions of some spectra look from a centre c.

    Attributes:
        carrier: (F, V) b of the module's formula, taken in the object's plane.
        azimuth: (V,) phi, rad.
    """

    def __init__(self, spectra: Spectra, centre: complex) -> None:
        self._across = spectra.antenna - centre
        self._wavenumbers = spectra.wavenumbers
        self._range = np.abs(self._across)
        self.azimuth = np.angle(self._across)
        self.carrier = spectra.waves(self._range) * (spectra.distance_m / self._range) ** 2

    def carrier_slopes(self) -> NDArray[np.complex128]:
        """(2, F, V) derivatives of the carrier with the centre's x and y."""
        toward = -self._across / self._range
        slope = self.carrier * (-1j * self._wavenumbers[:, None] - 2 / self._range)
        return np.stack([slope * toward.real, slope * toward.imag])

    def azimuth_slopes(self) -> NDArray[np.float64]:
        """(2, V) derivatives of the azimuth with the centre's x and y."""
        inverse = self._across / self._range**2
        return np.stack([inverse.imag, -inverse.real])


def near_field(wavenumbers: NDArray[np.float64], order: int, distance_m: float) -> NDArray[np.complex128]:
    """(F, 2 order + 1) the factor exp(-j m^2 / (2 kappa d))."""
    m = np.arange(-order, order + 1)
    return np.asarray(np.exp(-1j * m**2 / (2 * wavenumbers[:, None] * distance_m)))


def angular(azimuth: NDArray[np.float64], order: int) -> NDArray[np.complex128]:
    """(..., V, 2 order + 1) exp(j m phi)."""
    unit = np.exp(1j * azimuth)
    powers = np.empty((2 * order + 1, *azimuth.shape), dtype=np.complex128)
    powers[order] = 1
    for m in range(1, order + 1):
        np.multiply(powers[order + m - 1], unit, out=powers[order + m])
        np.conjugate(powers[order + m], out=powers[order - m])
    return np.ascontiguousarray(np.moveaxis(powers, 0, -1))


def turned(spectra: Spectra, signature: Signature, turn_rad: float) -> NDArray[np.complex128]:
    """(F, 2 M + 1) harmonics of a turned object, as they arrive at the distance of the spectra."""
    m = np.arange(-signature.order, signature.order + 1)
    near = near_field(spectra.wavenumbers, signature.order, spectra.distance_m)
    return np.asarray(signature.harmonics * near * np.exp(-1j * m * turn_rad))


def echo(spectra: Spectra, signature: Signature, pose: Pose) -> NDArray[np.complex128]:
    """(F, V) echo of an object in a pose, with unit gain."""
    at = Standpoint(spectra, pose.centre)
    weights = turned(spectra, signature, pose.turn_rad)
    return np.asarray(at.carrier * (weights @ angular(at.azimuth, signature.order).T))


def same_wavenumbers(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    """Whether both are the same frequencies, to SAME_WAVENUMBER."""
    return len(first) == len(second) and bool(np.abs(first - second).max() < SAME_WAVENUMBER)


def signature_wavenumbers(center_frequency_hz: float, bandwidth_hz: float) -> NDArray[np.float64]:
    """(F,) kappa of the multiples of FREQUENCY_STEP_HZ inside a band, rad/m.

    >>> signature_wavenumbers(3.95e9, 1.7e9).size
    9
    """
    low = (center_frequency_hz - bandwidth_hz / 2) / FREQUENCY_STEP_HZ
    high = (center_frequency_hz + bandwidth_hz / 2) / FREQUENCY_STEP_HZ
    steps = np.arange(np.ceil(low - 1e-6), np.floor(high + 1e-6) + 1)
    return np.asarray(4 * np.pi / SPEED_OF_LIGHT * FREQUENCY_STEP_HZ * steps)
