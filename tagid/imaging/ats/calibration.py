"""What is unknown about a recording, learned from the difference between measured and synthesized scans.

Scene and calibration share one objective; the scene takes many small steps, the few numbers here take a
Gauss-Newton step each time the scene has moved on, with derivatives by differences of the forward operator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import Aperture
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.types import BasebandScans

_STEP_M = 5e-4
"""Difference for the derivative by the axis distance: 5 degrees of phase."""

_PRIOR_AXIS_M = 0.03
_PRIOR_WOBBLE_RAD = 0.02
"""How far off distance and angle may be (one standard deviation): a tape measure, and 2 % of the speed."""

_PRIOR_GAIN = 0.1
"""Spread of the gain from scan to scan, relative."""

_BRIGHT = 0.05
"""Pixels under this part of the brightest are left out of the derivatives: they are noise and cost time."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The current estimate: see `Calibration`. `wobble` has (harmonics,) complex, `gain` (views,)."""

    offset_m: float
    sigma_m: float
    wobble: NDArray[np.complex128]
    gain: NDArray[np.float64]
    static: NDArray[np.complex64]

    @classmethod
    def none(cls, scans: BasebandScans, harmonics: int) -> Unknowns:
        """Nothing known to be wrong."""
        views, bins = scans.samples.shape
        wobble = np.zeros(harmonics, dtype=np.complex128)
        return cls(0.0, float("nan"), wobble, np.ones(views), np.zeros(bins, dtype=np.complex64))

    def phase(self, wavenumber: float) -> complex:
        """exp(2jk offset): keeps the phase of the scene as it is while the distance is learned.

        In the far field a range offset is nearly that one phase, which the complex scene could take just as
        well; with it the two do not pull at each other, and the offset is learned from the envelopes alone.
        """
        return complex(np.exp(2j * wavenumber * self.offset_m))

    def aperture(self, nominal: Aperture) -> Aperture:
        """Antenna positions under this estimate; free positions stay."""
        if nominal.angles is None or nominal.axis_distance is None:
            return nominal
        if self.offset_m == 0 and not self.wobble.any():
            return nominal
        angles = nominal.angles + angle_error(nominal.angles, self.wobble)
        return Aperture.turntable(angles, nominal.axis_distance + self.offset_m, nominal.height)


def angle_error(angles: NDArray[np.float64], wobble: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Re sum_k w_k exp(j k angle), k = 1.., (views,) rad."""
    orders = np.arange(1, len(wobble) + 1)
    return np.asarray((np.exp(1j * np.outer(angles, orders)) @ wobble).real, dtype=np.float64)


def improve(
    scans: BasebandScans,
    points: NDArray[np.float64],
    sigma: NDArray[np.complex64],
    now: Unknowns,
    what: tuple[str, ...],
) -> Unknowns:
    """One Gauss-Newton step on geometry, then gain and static component in closed form.

    Args:
        scans: measured scans with the nominal aperture.
        points: (P, 2) m.
        sigma: (P,) current reflectivity.
        now: current estimate.
        what: members of `CALIBRATIONS` to learn.

    Returns:
        A new estimate; the old one where the scene is blank.
    """
    magnitude = np.abs(sigma)
    bright = magnitude > _BRIGHT * magnitude.max(initial=0)
    if not bright.any():
        return now
    some, values = points[bright], sigma[bright]
    if ("axis" in what or "wobble" in what) and scans.aperture.angles is not None:
        now = _geometry(scans, some, values, now, what)
    seen = _synthesize(scans, some, values, now)
    if "gain" in what:
        seen = seen / now.gain[:, None]
        energy = (np.abs(seen) ** 2).sum(axis=1)
        # A prior worth 1 / spread^2 in units of the noise of one scan's estimate.
        noise = np.abs(scans.samples - now.static - seen * now.gain[:, None]) ** 2
        ridge = float(noise.mean()) / _PRIOR_GAIN**2
        match = (seen.conj() * (scans.samples - now.static)).real.sum(axis=1)
        gain = (match + ridge) / (energy + ridge)
        now = replace(now, gain=gain / gain.mean())
        seen = seen * now.gain[:, None]
    if "static" in what:
        now = replace(now, static=np.asarray((scans.samples - seen).mean(axis=0), dtype=np.complex64))
    return now


def _synthesize(
    scans: BasebandScans, points: NDArray[np.float64], sigma: NDArray[np.complex64], now: Unknowns
) -> NDArray[np.complex64]:
    operator = ForwardOperator(scans.with_aperture(now.aperture(scans.aperture)), points)
    factor = now.gain[:, None] * now.phase(scans.wavenumber)
    return np.asarray(operator.forward(sigma) * factor, dtype=np.complex64)


def _geometry(
    scans: BasebandScans,
    points: NDArray[np.float64],
    sigma: NDArray[np.complex64],
    now: Unknowns,
    what: tuple[str, ...],
) -> Unknowns:
    angles = scans.aperture.angles
    assert angles is not None  # the caller has looked
    columns: list[NDArray[np.complex64]] = []
    prior: list[float] = []
    if "axis" in what:
        ahead = _synthesize(scans, points, sigma, replace(now, offset_m=now.offset_m + _STEP_M))
        behind = _synthesize(scans, points, sigma, replace(now, offset_m=now.offset_m - _STEP_M))
        columns.append((ahead - behind) / (2 * _STEP_M))
        prior.append(_PRIOR_AXIS_M)
    if "wobble" in what and len(now.wobble):
        by_angle = _by_angle(scans, points, sigma, now)
        for order in range(1, len(now.wobble) + 1):
            columns.append(by_angle * np.cos(order * angles)[:, None])
            columns.append(by_angle * -np.sin(order * angles)[:, None])
            prior += [_PRIOR_WOBBLE_RAD] * 2
    seen = _synthesize(scans, points, sigma, now)
    residual = (scans.samples - now.static - seen).ravel()
    # The scene is still shrunk by its prior, and its phase is free: its best common factor goes first, and
    # small changes of it are solved for together with the geometry, so that neither biases it.
    seen = seen.ravel()
    factor = complex(np.vdot(seen, residual + seen) / max(float(np.vdot(seen, seen).real), 1e-30))
    residual = residual + seen - factor * seen
    jacobian = np.stack([factor * column.ravel() for column in (*columns, seen, 1j * seen)], axis=1)
    prior += [1.0, 1.0]
    real = np.concatenate([jacobian.real, jacobian.imag]).astype(np.float64)
    target = np.concatenate([residual.real, residual.imag]).astype(np.float64)
    variance = float((target**2).mean())
    old = np.array(([now.offset_m] if "axis" in what else []) + _pairs(now.wobble, what) + [0.0, 0.0])
    weight = variance / np.square(prior)
    normal = real.T @ real + np.diag(weight)
    change = np.linalg.solve(normal, real.T @ target - weight * old)
    # No step turns the phase by more than about one radian: further the derivatives do not reach.
    limit = np.where(np.arange(len(change)) == (0 if "axis" in what else -1), 0.006, 0.02)
    new = (old + np.clip(change, -limit, limit))[:-2]
    if "axis" in what:
        error = float(np.sqrt(variance * np.linalg.inv(normal)[0, 0]))
        now = replace(now, offset_m=float(new[0]), sigma_m=error)
        new = new[1:]
    if "wobble" in what and len(now.wobble):
        now = replace(now, wobble=new[0::2] + 1j * new[1::2])
    return now


def _pairs(wobble: NDArray[np.complex128], what: tuple[str, ...]) -> list[float]:
    return [float(v) for w in wobble for v in (w.real, w.imag)] if "wobble" in what else []


def _by_angle(
    scans: BasebandScans, points: NDArray[np.float64], sigma: NDArray[np.complex64], now: Unknowns
) -> NDArray[np.complex64]:
    """Derivative of every scan by its own angle, by a difference of 1 mrad to both sides."""
    step = 1e-3
    both = []
    for sign in (1, -1):
        aperture = now.aperture(scans.aperture)
        assert aperture.angles is not None and aperture.axis_distance is not None
        turned = Aperture.turntable(aperture.angles + sign * step, aperture.axis_distance, aperture.height)
        both.append(ForwardOperator(scans.with_aperture(turned), points).forward(sigma))
    factor = now.gain[:, None] * now.phase(scans.wavenumber)
    return np.asarray((both[0] - both[1]) / (2 * step) * factor, dtype=np.complex64)
