"""What is unknown about a recording, learned from the difference between measured and synthesized scans, and
how much of an echo arrives: what beam, range and the scene in its way leave of it.

Scene and calibration share one objective; the scene takes many small steps, the few numbers here take a
Gauss-Newton step each time the scene has moved on, together with what the scene could do instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.facts import CalibrationFacts
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans
from tagid.types import Floats, Samples

_PRIOR_AXIS = 0.395
_PRIOR_WOBBLE_RAD = 0.03
"""Standard deviation of the distance, in wavelengths (30 mm for a P440: a tape measure), and of the angle: a
speed that is 3 % off in every harmonic, which makes an angle error of 0.03 / order."""

_FIRST_ROUNDS, _FIRST_VIEWS = 3, 360
"""Sparse scenes before the fit, and views of them."""

_PRIOR_GAIN = 0.1
"""Spread of the gain from scan to scan, relative."""

_PRIOR_AMPLITUDE, _PRIOR_PLACE = 1.0, 0.0659
"""How far a spot of the scene may still change: its amplitude, relative, and its place, in wavelengths (5 mm
for a P440)."""

_BRIGHT = 0.05
"""Pixels under this part of the brightest are left out: they are noise and cost time."""

_SPOT = 0.2635
_MOST_SPOTS = 24
"""Pixels nearer than this belong to one spot (in wavelengths: the first null of J0(2kr) is at 0.19, 20 mm for
a P440 are 0.26); of more spots only the brightest may move on their own."""

_SECTORS = 18
"""Parts of the turn whose residuals are taken as independent of each other."""

_ITERATIONS = 4
_WORSE = 1.1

_MOST_AXIS, _MOST_WOBBLE_RAD = 0.1054, 0.03
"""No step turns the phase by more than about one radian: further the derivatives do not reach."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What is known of the recording beside the scene.

    Attributes:
        offset_m: true less given distance to the rotation axis.
        sigma_m: its standard error, from the curvature of the fit; nan where it was not learned.
        wobble: (harmonics,) complex w, rad: the angle error is Re sum w_k exp(j k angle), k = 1..
        wobble_sigma: (harmonics,) standard error of real and imaginary part, rad.
        gain: (views,) of every scan that is fitted; its mean is 1.
        gain_sigma: (views,) its standard error.
        static: (bins,) complex component that no turn changes.
        unexplained: power per sample that the scene left over when the geometry was last learned.
    """

    offset_m: float
    sigma_m: float
    wobble: NDArray[np.complex128]
    wobble_sigma: Floats
    gain: Floats
    gain_sigma: Floats
    static: Samples
    unexplained: float = np.inf

    @classmethod
    def none(cls, scans: BasebandScans, harmonics: int) -> Unknowns:
        """Nothing known to be wrong."""
        views, bins = scans.samples.shape
        wobble = np.zeros(harmonics, dtype=np.complex128)
        unknown = np.full(harmonics, np.nan), np.full(views, np.nan)
        static = np.zeros(bins, dtype=np.complex64)
        return cls(0.0, float("nan"), wobble, unknown[0], np.ones(views), unknown[1], static)

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
        return nominal.turned(angles, nominal.axis_distance + self.offset_m)

    def facts(self, distance_m: float | None, learned: tuple[str, ...]) -> CalibrationFacts:
        """What was learned, of `CALIBRATIONS`, as plain JSON values; `distance_m` is that of the axis, with
        the offset."""
        values: CalibrationFacts = {}
        if "axis" in learned and np.isfinite(self.sigma_m):
            values["axis"] = {"distance_m": distance_m, "offset_m": self.offset_m, "sigma_m": self.sigma_m}
        if "wobble" in learned and np.isfinite(self.wobble_sigma).all():
            values["wobble"] = [
                {
                    "harmonic": order,
                    "amplitude_deg": float(np.degrees(abs(w))),
                    "phase_deg": float(np.degrees(np.angle(w))),
                    "sigma_deg": float(np.degrees(sigma)),
                    "speed_percent": float(100 * order * abs(w)),
                }
                for order, (w, sigma) in enumerate(zip(self.wobble, self.wobble_sigma, strict=True), start=1)
            ]
        if "gain" in learned and np.isfinite(self.gain_sigma).all():
            scans, sigma = ([round(float(g), 5) for g in part] for part in (self.gain, self.gain_sigma))
            values["gain"] = {"scans": scans, "sigma": sigma, "spread": float(self.gain.std())}
        if "static" in learned:
            values["static"] = {"rms": float(np.sqrt((np.abs(self.static) ** 2).mean()))}
        return values


def begin(scans: BasebandScans, grid: ImageGrid, what: tuple[str, ...], harmonics: int) -> Unknowns:
    """Where the fit starts: the axis distance of the sharpest backprojection, and what sparse scenes teach.

    Derivatives reach a centimetre, the tape measure that gave the distance may be off by three. A wobble of 2
    % draws the neural scene to places from which it does not always come back, so that distance and wobble
    are first learned with a few sparse scenes. Raises UsageError: axis or wobble is to be learned from free
    antenna positions.
    """
    start = Unknowns.none(scans, harmonics)
    wrong = sorted({"axis", "wobble"} & set(what)) if scans.aperture.angles is None else []
    if wrong:
        raise UsageError(
            f"the capture has antenna positions: there is no turntable whose {' and '.join(wrong)} to learn",
            "Learn gain or static, or leave calibrate away.",
        )
    if "axis" in what:
        _, focus = focus_axis_distance(scans, grid)
        start = replace(start, offset_m=focus.offset_m) if focus.reliable else start
    if {"axis", "wobble"} & set(what) and np.any(scans.samples):
        few = select_views(scans, slice(None, None, -(-scans.aperture.views // _FIRST_VIEWS)))
        now = replace(Unknowns.none(few, harmonics), offset_m=start.offset_m)
        for _ in range(_FIRST_ROUNDS):
            seen = few.with_aperture(now.aperture(few.aperture))
            scene = sparse_recovery(seen, grid).values.ravel() / now.phase(few.wavenumber)
            now = improve(few, grid.points, scene.astype(np.complex64), now, what)
        start = replace(now, gain=start.gain, gain_sigma=start.gain_sigma, static=start.static)
    return start


def angle_error(angles: Floats, wobble: NDArray[np.complex128]) -> Floats:
    """Re sum_k w_k exp(j k angle), k = 1.., (views,) rad."""
    orders = np.arange(1, len(wobble) + 1)
    return np.asarray((np.exp(1j * np.outer(angles, orders)) @ wobble).real, dtype=np.float64)


def improve(
    scans: BasebandScans, points: Floats, sigma: Samples, now: Unknowns, what: tuple[str, ...]
) -> Unknowns:
    """Gauss-Newton on the geometry, then gain and static component in closed form: `what`, of `CALIBRATIONS`.

    The scans have their nominal aperture; the current reflectivity is sigma (P,) at points (P, 2), m. Returns
    a new estimate; the old one where the scene is blank.
    """
    magnitude = np.abs(sigma)
    bright = magnitude > _BRIGHT * magnitude.max(initial=0)
    if not bright.any():
        return now
    some, values = points[bright], sigma[bright]
    if ("axis" in what or "wobble" in what) and scans.aperture.angles is not None:
        now = _geometry(scans, some, values, now, what)
    seen = _synthesized(scans, some, values, now)
    if "gain" in what:
        now = _gains(scans, seen, now)
    if "static" in what:
        rest = scans.samples - seen * now.gain[:, None]
        now = replace(now, static=np.asarray(rest.mean(axis=0), dtype=np.complex64))
    return now


def _synthesized(scans: BasebandScans, points: Floats, sigma: Samples, now: Unknowns) -> Samples:
    """Scans (views, bins) of a scene under an estimate, without gain and static component."""
    operator = ForwardOperator(scans.with_aperture(now.aperture(scans.aperture)), points)
    return np.asarray(operator.forward(sigma) * now.phase(scans.wavenumber), dtype=np.complex64)


def _gains(scans: BasebandScans, seen: Samples, now: Unknowns) -> Unknowns:
    """Gain of every scan: least squares with the prior that it is 1 within `_PRIOR_GAIN`."""
    data = scans.samples - now.static
    noise = float((np.abs(data - seen * now.gain[:, None]) ** 2).mean()) / 2 * _correlation(scans)
    energy = (np.abs(seen) ** 2).sum(axis=1, dtype=np.float64)
    ridge = noise / _PRIOR_GAIN**2
    gain = ((seen.conj() * data).real.sum(axis=1, dtype=np.float64) + ridge) / (energy + ridge)
    mean = float(gain.mean())
    return replace(now, gain=gain / mean, gain_sigma=np.sqrt(noise / (energy + ridge)) / mean)


def _correlation(scans: BasebandScans) -> float:
    """Samples per independent one: the noise is oversampled, so that a sum over n holds n / this."""
    known = scans.independent_samples
    return max(1.0, scans.samples.size / known) if known > 0 else 1.0


def _geometry(
    scans: BasebandScans, points: Floats, sigma: Samples, now: Unknowns, what: tuple[str, ...]
) -> Unknowns:
    """Axis distance and wobble by Gauss-Newton, jointly with every spot's place and amplitude.

    The scene is only as far as the fit has come, and a wrong geometry has drawn it to wrong places: what its
    spots could still do is solved for together with the geometry (and then left to the fit), so that neither
    biases the other and the standard errors hold the doubt about the scene.
    """
    spots, start = _spots(points, sigma, _SPOT * scans.wavelength_m), now
    place = _PRIOR_PLACE * scans.wavelength_m
    for _ in range(_ITERATIONS):
        before = now
        now, changes = _step(scans, points, sigma, spots, now, what)
        points, sigma = points.copy(), sigma.copy()
        for members, (real, imaginary, x, y) in zip(spots, changes, strict=True):
            sigma[members] *= np.complex64(1 + np.clip(real, -0.7, 1) + 1j * np.clip(imaginary, -1, 1))
            points[members] += np.clip([x, y], -place, place)
        moved = abs(now.offset_m - before.offset_m) > 0.3 * now.sigma_m if "axis" in what else False
        if not moved and not (np.abs(now.wobble - before.wobble) > 0.3 * now.wobble_sigma).any():
            break
    rest = scans.samples - _synthesized(scans, points, sigma, now) * now.gain[:, None]
    now = replace(now, unexplained=float((np.abs(rest - rest.mean(axis=0)) ** 2).mean()))
    # A scene that explains much less than the one that taught last has nothing to teach.
    return now if now.unexplained <= _WORSE * start.unexplained else start


def _step(
    scans: BasebandScans,
    points: Floats,
    sigma: Samples,
    spots: list[NDArray[np.bool_]],
    now: Unknowns,
    what: tuple[str, ...],
) -> tuple[Unknowns, Floats]:
    """One step of Gauss-Newton: the new estimate, and what it changes of every spot (spots, 4).

    Those are the real and imaginary part of a relative change of its amplitude, and its shift in x and y, m.
    """
    aperture = now.aperture(scans.aperture)
    angles = scans.aperture.angles
    assert angles is not None and aperture.angles is not None  # the caller has looked
    operator = ForwardOperator(scans.with_aperture(aperture), points)
    factor = now.gain[:, None] * now.phase(scans.wavenumber)
    columns: list[NDArray[np.complexfloating]] = []
    total, by_axis, by_angle = (np.zeros(scans.samples.shape, dtype=np.complex64) for _ in range(3))
    radial, along = _motions(aperture)
    for members in spots:
        values = np.where(members, sigma, 0)
        seen, slope = operator.forward(values) * factor, operator.slope(values) * factor
        weight = np.abs(values)
        sight = aperture.positions - np.append(weight @ points / weight.sum(), 0.0)
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        total += seen
        by_axis += slope * (sight * radial).sum(axis=1)[:, None]
        by_angle += slope * (sight * along).sum(axis=1)[:, None]
        columns += [seen, 1j * seen, -slope * sight[:, :1], -slope * sight[:, 1:2]]
    lam = scans.wavelength_m
    prior = [_PRIOR_AMPLITUDE, _PRIOR_AMPLITUDE, _PRIOR_PLACE * lam, _PRIOR_PLACE * lam] * len(spots)
    wanted: list[NDArray[np.complexfloating]] = []
    spread, old, limit = [], [], []
    if "axis" in what:
        wanted.append(by_axis + 2j * scans.wavenumber * total)
        spread, old, limit = [_PRIOR_AXIS * lam], [now.offset_m], [_MOST_AXIS * lam]
    if "wobble" in what:
        for order, value in enumerate(now.wobble, start=1):
            turn = np.exp(1j * order * angles)[:, None]
            wanted += [by_angle * turn.real, by_angle * -turn.imag]
            spread += [_PRIOR_WOBBLE_RAD / order] * 2
            old += [value.real, value.imag]
            limit += [_MOST_WOBBLE_RAD / order] * 2
    # What is constant over the views may be clutter, or its removal: it tells nothing, so it goes everywhere.
    residual = scans.samples - total
    varying = [c - c.mean(axis=0) for c in (*wanted, *columns)]
    change, error = _solve(
        varying, residual - residual.mean(axis=0), [*spread, *prior], old, _correlation(scans)
    )
    new: Floats = np.array(old) + np.clip(change[: len(old)], -np.array(limit), limit)
    changes = change[len(old) :].reshape(-1, 4)
    if "axis" in what:
        now = replace(now, offset_m=float(new[0]), sigma_m=float(error[0]))
        new, error = new[1:], error[1:]
    if "wobble" in what and len(now.wobble):
        count = 2 * len(now.wobble)
        # Of a complex number the error of its parts: their root mean square.
        both = np.sqrt((error[0:count:2] ** 2 + error[1:count:2] ** 2) / 2)
        now = replace(now, wobble=new[0:count:2] + 1j * new[1:count:2], wobble_sigma=both)
    return now, changes


def _solve(
    columns: list[NDArray[np.complexfloating]],
    residual: NDArray[np.complexfloating],
    prior: list[float],
    old: list[float],
    correlation: float,
) -> tuple[Floats, Floats]:
    """Maximum a posteriori change of all unknowns, and their standard errors.

    `columns` are the derivatives of the scans, (views, bins), by every unknown, `prior` the standard
    deviations of the unknowns about zero, `old` the present values of the first of them; the others are zero.
    """
    jacobian = np.stack([c.ravel() for c in columns], axis=1).astype(np.complex64)
    target = residual.astype(np.complex64).ravel()
    normal = (jacobian.conj().T @ jacobian).real.astype(np.float64)
    slope = (jacobian.conj().T @ target).real.astype(np.float64)
    at = np.zeros(len(columns))
    at[: len(old)] = old
    energy = float(np.vdot(target, target).real)
    change: Floats = np.zeros(len(columns))
    variance = energy / (2 * target.size)
    for _ in range(3):  # the noise is what is left after the step, not before it
        weight = max(variance, 1e-30) * correlation / np.square(prior)
        change = np.asarray(np.linalg.solve(normal + np.diag(weight), slope - weight * at), dtype=np.float64)
        energy_left = energy - 2 * float(change @ slope) + float(change @ normal @ change)
        variance = max(energy_left, 1e-6 * energy) / (2 * target.size)
    inverse = np.linalg.inv(normal + np.diag(weight))
    by_noise = variance * correlation * np.diag(inverse)
    by_sector = np.diag(inverse @ _spread_over_sectors(columns, residual, change) @ inverse)
    return change, np.sqrt(np.maximum(np.maximum(by_noise, by_sector), 0))


def _spread_over_sectors(
    columns: list[NDArray[np.complexfloating]], residual: NDArray[np.complexfloating], change: Floats
) -> Floats:
    """Covariance of the slope as the sectors of the turn differ in it (White, Econometrica 48, 1980).

    In noise alone it is what the noise makes; where objects do not echo as the model says, neighbouring views
    are wrong alike, and the standard errors must hold that.
    """
    stack = np.stack(columns, axis=2)
    remainder = residual - stack @ change
    views = len(remainder)
    slopes = np.array(
        [
            np.einsum("vbm,vb->m", stack[part].conj(), remainder[part]).real
            for part in np.array_split(np.arange(views), min(_SECTORS, views))
        ]
    )
    slopes -= slopes.mean(axis=0)
    return np.asarray(slopes.T @ slopes * len(slopes) / max(len(slopes) - 1, 1), dtype=np.float64)


def _motions(aperture: Aperture) -> tuple[Floats, Floats]:
    """(views, 3) how the antenna moves with the axis distance, and per radian with the object's angle."""
    assert aperture.angles is not None and aperture.axis_distance is not None
    x, y = np.cos(aperture.angles), -np.sin(aperture.angles)
    zero = np.zeros_like(x)
    return np.stack([x, y, zero], 1), aperture.axis_distance * np.stack([y, -x, zero], 1)


def _spots(points: Floats, sigma: Samples, apart_m: float) -> list[NDArray[np.bool_]]:
    """Members (P,) of every spot, brightest first: each point belongs to the nearest centre."""
    magnitude = np.abs(sigma)
    centres: list[int] = []
    for i in np.argsort(-magnitude):
        if len(centres) == _MOST_SPOTS:
            break
        if all(np.hypot(*(points[i] - points[c])) >= apart_m for c in centres):
            centres.append(int(i))
    away = np.hypot(*(points[:, None] - points[centres][None]).transpose(2, 0, 1))
    nearest = away.argmin(axis=1)
    return [nearest == k for k in range(len(centres))]


_NEAREST = 0.05
"""Points nearer than this part of the middle distance get no more light: 5 cm at 1 m."""


def illumination(
    points: NDArray[np.float64], positions: NDArray[np.float64], spreading: float, beam_width_rad: float
) -> NDArray[np.float32]:
    """(views, points) float32 (R0 / R)^spreading 2^-(2 theta / width)^2, 1 at the origin, where the beam
    looks.

    Points (points, 2) are in the plane z = 0, antenna positions are (views, 3), m. The exponent of the
    amplitude is 2 for a point reflector (radar equation), 0 for none; the width is the full -3 dB one of the
    one-way power pattern, whose value is the two-way amplitude, rad, 0 for all round.
    """
    there = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    out = np.empty((len(positions), len(points)), dtype=np.float32)
    for row, antenna in zip(out, positions, strict=True):
        line = there - antenna
        middle = max(float(np.linalg.norm(antenna)), 1e-9)
        distance = np.maximum(np.linalg.norm(line, axis=1), _NEAREST * middle)
        row[:] = (middle / distance) ** spreading
        if beam_width_rad > 0:
            cosine = np.clip(-(line @ antenna) / (distance * middle), -1, 1)
            row *= 2.0 ** -((2 * np.arccos(cosine) / beam_width_rad) ** 2)
    return out
