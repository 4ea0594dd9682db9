"""Where an enrolled body or object stands in a capture: coarse search over rotation and centre, then descent.

The linear amplitudes are eliminated at every step, so only the pose is searched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.tags.bodies.signature import (
    Pose,
    Signature,
    Standpoint,
    angular,
    near_field,
    same_wavenumbers,
    turned,
)
from tagid.tags.bodies.spectra import Spectra, centred

CENTRE_SIGMA_M = 0.008
"""Standard deviation of where an object stands about the axis, per coordinate: it is placed by eye."""
CENTRE_REACH_M = 0.0125
CENTRE_GRID_M = 0.003
"""Step of the coarse search over the centre; half a diagonal is a phase of kappa * 2.1 mm = 0.4 rad."""
ROTATIONS = 256
"""Steps of the coarse search over rotation, 1.4 degrees: half a step turns the harmonic 26 by 0.3 rad."""
STARTS, APART_RAD = 4, np.pi / 6
"""Starts of the descent, and their least difference in rotation."""
ROUND_GRID_M = 0.002
_NO_NOISE = 1e-9


@dataclass(frozen=True, eq=False)
class Linear:
    """Columns of a linear model and their derivatives.

    Attributes:
        columns: (F, V, N).
        slopes: (P, F, V, N) derivatives with the P parameters.
    """

    columns: NDArray[np.complex128]
    slopes: NDArray[np.complex128]


@dataclass(frozen=True)
class Match:
    """A signature in a capture.

    Attributes:
        pose: the best one.
        residual: energy that the signature does not explain, in the units of the spectra.
    """

    pose: Pose
    residual: float


def noise_of(spectra: Spectra) -> float:
    """Noise variance of one value; where it is not known, or there is none, far below the echo."""
    return max(spectra.noise, _NO_NOISE * spectra.energy / spectra.data.size)


def descend(
    spectra: Spectra,
    model: Callable[[NDArray[np.float64]], Linear],
    x: NDArray[np.float64],
    iterations: int = 12,
    sigmas: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], float]:
    """Levenberg-Marquardt with the linear amplitudes eliminated (variable projection, Kaufman 1975).

    The model is one of parameters (P,), of which the first two are the centre, m. They begin at x and have
    the standard deviations `sigmas` (P,) about 0, inf where they are free; None: those of the centre are
    CENTRE_SIGMA_M, the others are free.

    Returns parameters, and the energy not explained, in the units of the spectra.
    """
    if sigmas is None:
        sigmas = np.full(len(x), np.inf)
        sigmas[:2] = CENTRE_SIGMA_M
    prior = noise_of(spectra) / sigmas**2
    data = spectra.data

    def rest(columns: NDArray[np.complex128]):  # type: ignore[no-untyped-def]
        columns = columns - columns.mean(axis=1, keepdims=True)
        q, r = np.linalg.qr(columns)
        inner = q.conj().swapaxes(1, 2) @ data[..., None]
        return data - (q @ inner)[..., 0], q, r, inner

    def amplitudes_of(r: NDArray[np.complex128], inner: NDArray[np.complex128]) -> NDArray[np.complex128]:
        load = 1e-12 * np.abs(r).max(axis=(1, 2), keepdims=True) + 1e-300
        # More amplitudes than views: those that the views cannot tell are 0.
        if lacking := r.shape[2] - r.shape[1]:
            r, inner = (np.pad(block, ((0, 0), (0, lacking), (0, 0))) for block in (r, inner))
        return np.asarray(np.linalg.solve(r + load * np.eye(r.shape[-1]), inner)[..., 0])

    parts = model(x)
    residual, q, r, inner = rest(parts.columns)
    cost, damping = float(np.sum(np.abs(residual) ** 2) + prior @ x**2), 1e-2
    for _ in range(iterations):
        slopes = np.einsum("pfvn,fn->pfv", parts.slopes, amplitudes_of(r, inner))
        slopes = slopes - slopes.mean(axis=2, keepdims=True)
        slopes = slopes - (q @ (q.conj().swapaxes(1, 2) @ slopes[..., None]))[..., 0]
        jacobian = slopes.reshape(len(x), -1)
        normal = np.real(jacobian.conj() @ jacobian.T) + np.diag(prior)
        gradient = np.real(jacobian.conj() @ residual.ravel()) - prior * x
        gain = 0.0
        for _ in range(4):
            damped = normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.trace(normal) * np.eye(len(x))
            trial = x + np.linalg.solve(damped, gradient)
            trial_parts = model(trial)
            trial_rest = rest(trial_parts.columns)
            trial_cost = float(np.sum(np.abs(trial_rest[0]) ** 2) + prior @ trial**2)
            if trial_cost < cost:
                gain = cost - trial_cost
                x, parts, cost, damping = trial, trial_parts, trial_cost, damping / 5
                residual, q, r, inner = trial_rest
                break
            damping *= 6
        if gain < 1e-5 * cost:
            break
    return x, float(np.sum(np.abs(residual) ** 2))


def round_centre(spectra: Spectra) -> tuple[complex, float]:
    """Centre of the body of revolution that explains a capture best, m, and the residual energy.

    The centre of a round body that stands off the axis comes out to about 0.3 mm.
    """
    count = int(CENTRE_REACH_M / ROUND_GRID_M)
    line = ROUND_GRID_M * np.arange(-count, count + 1)
    grid = (line[:, None] + 1j * line[None]).ravel()
    grid = grid[np.abs(grid) <= CENTRE_REACH_M]
    rho = np.abs(spectra.antenna - grid[:, None])
    columns = centred(spectra.waves(rho) * (spectra.distance_m / rho) ** 2)
    along = np.abs((columns.conj() * spectra.data[:, None]).sum(axis=-1)) ** 2
    size = (columns.real**2 + columns.imag**2).sum(axis=-1)
    start = complex(grid[int(np.argmax((along / np.maximum(size, 1e-9 * spectra.views)).sum(axis=0)))])

    def model(x: NDArray[np.float64]) -> Linear:
        at = Standpoint(spectra, complex(x[0], x[1]))
        return Linear(at.carrier[..., None], at.carrier_slopes()[..., None])

    x, residual = descend(spectra, model, np.array([start.real, start.imag]))
    return complex(x[0], x[1]), residual


def at_pose(at: Standpoint, weights: NDArray[np.complex128]) -> Linear:
    """The echo of harmonics that are turned already (F, 2 M + 1), and its slopes with the pose x, y, turn."""
    order = weights.shape[1] // 2
    basis = angular(at.azimuth, order)
    pattern = weights @ basis.T
    bent = (weights * (1j * np.arange(-order, order + 1))) @ basis.T
    moved = at.carrier_slopes() * pattern + at.carrier * bent * at.azimuth_slopes()[:, None, :]
    slopes = np.concatenate([moved, (-at.carrier * bent)[None]])
    return Linear((at.carrier * pattern)[..., None], slopes[..., None])


def refine(
    spectra: Spectra, signature: Signature, pose: Pose, *, split: bool = False, iterations: int = 12
) -> Match:
    """The pose near a start where a signature explains most of spectra at the same frequencies; its round
    part (m = 0) has a gain of its own if `split`.
    """
    order = signature.order

    def model(x: NDArray[np.float64]) -> Linear:
        at = Standpoint(spectra, complex(x[0], x[1]))
        weights = turned(spectra, signature, float(x[2]))
        if split:
            weights[:, order] = 0
        parts = at_pose(at, weights)
        columns, slopes = parts.columns, parts.slopes
        if split:
            slope = at.carrier_slopes()
            round_slopes = np.concatenate([slope, np.zeros_like(slope[:1])])[..., None]
            columns = np.concatenate([at.carrier[..., None], columns], axis=-1)
            slopes = np.concatenate([round_slopes, slopes], axis=-1)
        return Linear(columns, slopes)

    x, residual = descend(spectra, model, np.array([*pose.centre_m, pose.turn_rad]), iterations)
    return Match(Pose((float(x[0]), float(x[1])), float(np.mod(x[2], 2 * np.pi))), residual)


class PoseSearch:
    """Coarse search for the pose of any signature, of harmonics up to `order`, in one capture.

    What depends on the capture alone is computed once: at every centre of a grid, and at those `around`, x +
    jy, m, the products of the harmonics with the data, with the room and a body of revolution, and with each
    other. The last depend on differences of harmonics only, so all rotations of a signature cost four Fourier
    transforms per centre and frequency.
    """

    def __init__(self, spectra: Spectra, order: int, around: tuple[complex, ...] = ()) -> None:
        self.spectra = spectra
        # Five frequencies or a few more of them.
        self._step = max(1, (len(spectra.wavenumbers) + 4) // 5)
        self._thin = spectra.thinned(self._step)
        self._order = order
        count = int(CENTRE_REACH_M / CENTRE_GRID_M)
        line = CENTRE_GRID_M * np.arange(-count, count + 1)
        grid = [complex(x, y) for x in line for y in line if np.hypot(x, y) <= CENTRE_REACH_M]
        self._centres = np.array([*around, *grid])
        across = self._thin.antenna - self._centres[:, None]
        rho = np.abs(across)
        carrier = self._thin.waves(rho) * (self._thin.distance_m / rho) ** 2
        carrier = np.ascontiguousarray(np.moveaxis(carrier, 0, 1))
        unit = centred(carrier)
        unit = unit / np.maximum(np.linalg.norm(unit, axis=-1, keepdims=True), 1e-9)
        along = (unit.conj() * self._thin.data).sum(axis=-1, keepdims=True)
        rest = self._thin.data - along * unit
        self._left = np.sum(np.abs(rest) ** 2, axis=(1, 2))
        basis = angular(np.angle(across), 2 * order)
        first = basis[..., order : 3 * order + 1].conj()
        flat = np.full_like(carrier, 1 / np.sqrt(spectra.views))
        # (C, F, 2 M + 1) inner products of each harmonic with the data, the room and the round body.
        self._scale = max(float(np.sqrt(np.mean(self._left))), 1e-300)
        # Single precision is enough: what turns is not nearly constant over the views, nor nearly round.
        self._data, self._room, self._round = (
            ((carrier.conj() * other) @ first).astype(np.complex64)
            for other in (rest / self._scale, flat, unit)
        )
        # (C, F, 4 M + 1) inner products of harmonics by their difference.
        self._lags = ((np.abs(carrier) ** 2 + 0j) @ basis).astype(np.complex64)

    def candidates(self, signature: Signature, count: int) -> list[Pose]:
        """The poses that explain most and differ in rotation, best first.

        Raises DataError where signature and capture are at different frequencies.
        """
        energies = self._energies(signature)
        poses: list[Pose] = []
        for index in np.argsort(energies, axis=None)[:400]:
            i, turn = np.unravel_index(index, energies.shape)
            at = complex(self._centres[i])
            pose = Pose((at.real, at.imag), 2 * np.pi * int(turn) / ROTATIONS)
            if all(
                abs(np.angle(np.exp(1j * (pose.turn_rad - other.turn_rad)))) > APART_RAD for other in poses
            ):
                poses.append(pose)
            if len(poses) == count:
                break
        return poses

    def _energies(self, signature: Signature) -> NDArray[np.float64]:
        """(C, ROTATIONS) residual energy with every centre and rotation."""
        if (
            not same_wavenumbers(self.spectra.wavenumbers, signature.wavenumbers)
            or signature.order > self._order
        ):
            raise DataError(
                f"the capture's band is not that in which {signature.name} was enrolled",
                "Enroll it again with this radar.",
            )
        order = signature.order
        cut = slice(self._order - order, self._order + order + 1)
        near = near_field(self._thin.wavenumbers, order, self._thin.distance_m)
        weights = signature.turning[:: self._step] * near
        loudest = max(float(np.abs(weights).max()), 1e-300)
        weights = (weights / loudest).astype(np.complex64)
        along, room, body = (
            _over_rotation(weights.conj() * part[..., cut]) for part in (self._data, self._room, self._round)
        )
        pairs = np.stack([np.correlate(w, w, "full") for w in weights.conj()])
        wide = slice(2 * (self._order - order), 2 * (self._order + order) + 1)
        size = _over_rotation(pairs * self._lags[..., wide].conj()).real
        size -= np.abs(room) ** 2 + np.abs(body) ** 2
        noise = signature.noise[:: self._step] / loudest**2 * 2 * order * self._thin.views
        explained = np.sum(np.abs(along) ** 2 / (np.maximum(size, 0) + noise[:, None] + 1e-300), axis=1)
        return np.asarray(self._left[:, None] - self._scale**2 * explained)


def _over_rotation(values: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """(..., ROTATIONS) sum over m = -M..M of values (..., 2 M + 1) times exp(j m g) at every rotation g."""
    most = values.shape[-1] // 2
    spectrum = np.zeros((*values.shape[:-1], ROTATIONS), np.complex64)
    spectrum[..., np.arange(-most, most + 1) % ROTATIONS] = values
    return np.asarray(np.fft.ifft(spectrum, axis=-1) * ROTATIONS)


def match(spectra: Spectra, signature: Signature) -> Match:
    """The best of `matches`."""
    return matches(spectra, signature, PoseSearch(spectra, signature.order))[0]


def matches(
    spectra: Spectra, signature: Signature, search: PoseSearch, *, split: bool = False
) -> list[Match]:
    """Poses of a signature in a capture, over all rotations and centres near the axis, best first.

    The search is of that capture; `split` gives the round part a gain of its own, for a signature whose m = 0
    is not known yet. Raises DataError where the two are at different frequencies.
    """
    refined: list[Match] = []
    for start in search.candidates(signature, STARTS):
        near = refine(spectra, signature, start, split=True, iterations=12 if split else 5)
        refined.append(near if split else refine(spectra, signature, near.pose))
    return sorted(refined, key=lambda candidate: candidate.residual)
