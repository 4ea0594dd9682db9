"""A layout measured on the real object: captures aligned with each other, checked, and averaged.

One capture of a different object would corrupt every later reading. It is reported by name and nothing is
enrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.counting import counted
from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import find_reflectors
from tagid.errors import DataError
from tagid.imaging.types import BasebandScans
from tagid.reading.views import fold_views
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.codebook import CENTRE_TOLERANCE_M, CONFUSABLE_M, Pairing, best_pairing
from tagid.tags.layouts.layout import Layout, rotation_matrix

_STEP_M = 2e-4
_LOAD = 1e-9


def position_covariances(field: MatchedField, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 2, 2) covariance, m^2, of least-squares positions (K, 2), m, with free complex amplitudes.

    It is the inverse Fisher information. Let S be the templates, a the amplitudes, and J the derivatives of S
    a with respect to the coordinates, made orthogonal to S because the amplitudes are fitted too. The
    covariance is (2 / v Re(J^H J))^-1 (Kay 1993, section 15.7), v being the variance of a complex sample. v
    is the noise variance or the variance of the residual, whichever is larger, so unexplained echoes of the
    object count as noise. Correlations between reflectors are omitted from the result.
    """
    k = len(positions)
    templates = field.templates(positions).astype(np.complex128)
    amplitudes, *_ = np.linalg.lstsq(templates.T, field.data.astype(np.complex128), rcond=None)
    residual = field.data - amplitudes @ templates
    variance = max(float(np.mean(np.abs(residual) ** 2)), field.noise_variance, 1e-30)
    slopes = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = _STEP_M
        ahead, behind = field.templates(positions + step), field.templates(positions - step)
        slopes.append((ahead - behind).astype(np.complex128) / (2 * _STEP_M) * amplitudes[:, None])
    jacobian = np.stack(slopes, axis=1).reshape(2 * k, -1)
    basis, _ = np.linalg.qr(templates.T)
    jacobian = jacobian - (jacobian @ basis.conj()) @ basis.T
    information = 2 / variance * np.real(jacobian.conj() @ jacobian.T)
    information += _LOAD * np.trace(information) / (2 * k) * np.eye(2 * k) + 1e-6 * np.eye(2 * k)
    whole = np.linalg.inv(information)
    return np.array([whole[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(k)])


STRONG_DB = -9.0
"""A tag's reflectors have similar amplitudes: one weaker than this, relative to the strongest, is not counted
as part of the layout."""
SEARCHED_M = 0.24
"""Radius searched by default. A reflector outside it is not only missed: its echo biases those inside."""
MOST_SEARCHED_M = 0.4
"""Largest radius searched when `imaging.extent_m` is set for a wide object: such a disc has 20,000 pixels."""
AGREE_M = 3e-3
"""Captures agree if every reflector is within this distance of its counterpart, or within AGREE_SIGMAS
standard deviations of the noise: simulated captures at 36 views and 10 dB, with 3 % wobble, differ by at most
3 mm."""
AGREE_SIGMAS = 5.0
UNKNOWN_SCATTER_M = 1e-3
"""Scatter per coordinate that is assumed when there are fewer than three captures to estimate it from: the
value measured at 36 views and 0 dB."""
UNEXPLAINED = 0.12
"""Largest share of the moving echo that the reflectors may leave unexplained: bare tags simulated full-wave
leave up to 7 %, tags on a mug's handle or a helmet shell 18 to 24 %."""
_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Sighting:
    """The strong reflectors of one capture.

    Attributes:
        name: name of the capture, used in messages.
        positions: (K, 2) m, in the turntable's frame.
        covariances: (K, 2, 2) m^2, covariance of each position due to noise alone.
    """

    name: str
    positions: NDArray[np.float64]
    covariances: NDArray[np.float64]

    @classmethod
    def of(cls, scans: BasebandScans, name: str, radius_m: float = SEARCHED_M) -> Sighting:
        """The strong reflectors of focused scans within `radius_m` of the axis.

        Raises DataError if the scans do not cover the object's range.
        """
        reflectors = [r for r in find_reflectors(scans, radius_m) if r.amplitude_db >= STRONG_DB]
        positions = np.array([(r.x_m, r.y_m) for r in reflectors]).reshape(-1, 2)
        if not reflectors:
            return cls(name, positions, np.zeros((0, 2, 2)))
        radius = radius_m + 0.02
        field = MatchedField(fold_views(scans, radius), radius)
        return cls(name, positions, position_covariances(field, positions))

    @property
    def sigma_m(self) -> NDArray[np.float64]:
        """(K,) standard deviation of each position along its worst direction, m."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariances)[:, -1]))

    def mirrored(self) -> Sighting:
        """The sighting that results if the object turned in the opposite direction."""
        flip = np.array([1.0, -1.0])
        return Sighting(self.name, self.positions * flip, self.covariances * np.outer(flip, flip))


@dataclass(frozen=True, eq=False)
class LayoutEstimate:
    """A layout measured on the real object.

    Attributes:
        layout: mean positions with their covariance, relative to the object's mean axis, with the outermost
            reflector on +x.
        spread_m: (K,) RMS scatter of each reflector over the captures, m.
        scatter_m: standard deviation per coordinate, over the captures, in excess of noise, m.
        rotations_deg: rotation of each capture relative to the layout, degrees.
        mirrored: names of the captures that were mirrored because the direction of rotation is unknown.
    """

    layout: Layout
    spread_m: NDArray[np.float64]
    scatter_m: float
    rotations_deg: tuple[float, ...]
    mirrored: tuple[str, ...] = ()


def average(
    sightings: Sequence[Sighting],
    name: str,
    *,
    direction_known: bool = True,
) -> LayoutEstimate:
    """Layout from captures of one object at any rotation and position.

    Reflectors are paired, rotated and shifted onto their mean (generalised Procrustes analysis, Gower 1975).
    Each is weighted by the inverse of its covariance in that capture plus a scatter common to all captures,
    which is estimated from what noise does not explain (Paule and Mandel 1982): wobble, aspect, a displaced
    axis; with fewer than three it is assumed. The origin is the mean position of the turntable's axis on the
    object, so errors in centring average out. Mirror images also agree unless every capture turned in the
    configured direction.

    Raises DataError: fewer than two reflectors are seen, or a capture does not agree with the others; the
    message names it and the difference.
    """
    if not sightings:
        raise DataError("no capture to measure a layout on", "Give at least one capture of the object.")
    used, heart, flipped = _agreeing(sightings, direction_known)
    mean = used[heart].positions
    axis = np.zeros(2)
    turns = np.zeros(len(used))
    scatter = UNKNOWN_SCATTER_M**2
    k = len(mean)
    for _ in range(_ROUNDS):
        placed, weights, axes = [], [], []
        for i, sighting in enumerate(used):
            # Each capture may be off the axis by as much as the reader allows. A larger shift would permit a
            # wrong pairing: half a turn and a shift can always exchange two reflectors.
            pair = best_pairing(sighting.positions, mean, 2 * CENTRE_TOLERANCE_M)
            order = np.argsort(pair.partner)
            points, noise = sighting.positions[order], sighting.covariances[order]
            turn, shift = _placed(points, noise, mean, pair, scatter)
            rotation = rotation_matrix(turn)
            placed.append(points @ rotation.T + shift)
            weights.append(np.linalg.inv(rotation @ noise @ rotation.T + scatter * np.eye(2)))
            turns[i] = turn
            axes.append(shift)
        seen, weight = np.array(placed), np.array(weights)
        covariance = np.linalg.inv(weight.sum(axis=0))
        mean = np.einsum("kij,kj->ki", covariance, np.einsum("nkij,nkj->ki", weight, seen))
        axis = np.mean(axes, axis=0)
        if len(used) >= 3:
            scatter = _excess(seen - mean, np.linalg.inv(weight) - scatter * np.eye(2), k)
    spread = np.sqrt(np.mean(np.sum((seen - mean) ** 2, axis=2), axis=0))
    positions = mean - axis
    outermost = int(np.argmax(np.linalg.norm(positions, axis=1)))
    turn = -float(np.arctan2(positions[outermost, 1], positions[outermost, 0]))
    final = rotation_matrix(turn)
    notes = f"Measured on {len(used)} captures, scatter up to {spread.max() * 1e3:.1f} mm."
    if len(used) < 3:
        notes = f"Measured on {counted(len(used), 'capture')}; three or more show their scatter."
    # Rounded to 0.1 micrometres: further digits carry no information.
    rounded = np.round(positions @ final.T, 7) + 0.0
    spreads = np.round(final @ covariance @ final.T, 12)
    layout = Layout(name, rounded, "other", notes=notes, covariance=spreads)
    degrees = tuple(float(np.rad2deg(-(t + turn)) % 360) for t in turns)
    return LayoutEstimate(layout, spread, float(np.sqrt(scatter)), degrees, flipped)


def trusted(sightings: Sequence[Sighting], spectra: Sequence[Spectra]) -> str:
    """The reason not to trust these reflectors; empty if they explain the moving echo.

    Points explain the moving echo of a bare tag. A body that is off the axis or not round also produces
    apparent reflectors and shifts those of the tag; points then leave a large residual. The spectra are of
    the same captures.
    """
    shares = []
    for sighting, scans in zip(sightings, spectra, strict=True):
        place = sighting.positions[:, 0] + 1j * sighting.positions[:, 1]
        distance = np.hypot(np.abs(scans.antenna - place[:, None]), scans.height_m)
        columns = centred(scans.waves(distance)).transpose(0, 2, 1)
        q = np.linalg.qr(columns)[0]
        residual = scans.data - (q @ (q.conj().swapaxes(1, 2) @ scans.data[..., None]))[..., 0]
        signal = max(scans.energy - scans.noise_energy, 1e-30)
        shares.append((float(np.sum(np.abs(residual) ** 2)) - scans.noise_energy) / signal)
    worst = float(np.median(shares))
    if worst <= UNEXPLAINED:
        return ""
    return f"point reflectors leave {worst:.0%} of the moving echo unexplained: it comes from the body"


def _agreeing(
    sightings: Sequence[Sighting], direction_known: bool
) -> tuple[list[Sighting], int, tuple[str, ...]]:
    """The sightings (mirrored where needed), the index of the one that all others agree with, mirrored names.

    Raises DataError that names the captures outside the largest group that agrees.
    """
    n = len(sightings)
    pairs = {(i, j): _misfit_m(sightings[i], sightings[j]) for i in range(n) for j in range(i)}

    def agree(i: int, j: int) -> bool:
        straight, mirrored, allowed = pairs[max(i, j), min(i, j)]
        return min(straight, np.inf if direction_known else mirrored) <= allowed

    groups = [[j for j in range(n) if j == i or agree(i, j)] for i in range(n)]
    heart = max(range(n), key=lambda i: (len(groups[i]), len(sightings[i].positions)))
    odd = [i for i in range(n) if i not in groups[heart]]
    size = len(sightings[heart].positions)
    if size < 2 and 2 * len(groups[heart]) > n:
        raise DataError(
            f"{len(groups[heart])} of {n} captures show {size} reflectors, a layout needs two",
            "Check that the object is tagged and in the beam, and record more views. A reflector on the axis "
            "of rotation cannot be seen.",
        )
    if odd:
        against = {i: pairs[max(i, heart), min(i, heart)] for i in odd}
        raise _disagreement(sightings, groups[heart], against)
    worst = max(range(n), key=lambda i: float(sightings[i].sigma_m.max()))
    if sightings[worst].sigma_m.max() > CONFUSABLE_M / 2:
        raise DataError(
            f"{sightings[worst].name} locates a reflector only to within "
            f"{sightings[worst].sigma_m.max() * 1e3:.1f} mm",
            "Record it again with more views or closer to the radar, or omit it.",
        )
    over = [i for i in range(n) if i != heart and _turned_over(pairs[max(i, heart), min(i, heart)])]
    if direction_known:
        over = []
    used = [sighting.mirrored() if i in over else sighting for i, sighting in enumerate(sightings)]
    return used, heart, tuple(sightings[i].name for i in over)


def _turned_over(pair: tuple[float, float, float]) -> bool:
    straight, mirrored, allowed = pair
    return straight > allowed >= mirrored


def _misfit_m(a: Sighting, b: Sighting) -> tuple[float, float, float]:
    """Largest distance between counterparts, the same with one sighting mirrored, and the tolerance, m."""
    if len(a.positions) != len(b.positions):
        return np.inf, np.inf, 0.0
    if len(a.positions) < 2:
        return 0.0, 0.0, 0.0
    straight, mirrored = (
        best_pairing(points, b.positions, 2 * CENTRE_TOLERANCE_M).worst_m
        for points in (a.positions, a.mirrored().positions)
    )
    noise = float(np.hypot(a.sigma_m.max(), b.sigma_m.max()))
    return straight, mirrored, max(AGREE_M, min(AGREE_SIGMAS * noise, CONFUSABLE_M))


def _disagreement(
    sightings: Sequence[Sighting],
    together: list[int],
    odd: dict[int, tuple[float, float, float]],
) -> DataError:
    """The error that names the captures that differ from the others."""
    size = len(sightings[together[0]].positions)
    if 2 * len(together) <= len(sightings):
        seen = ", ".join(
            f"{sighting.name}: {counted(len(sighting.positions), 'reflector')}" for sighting in sightings
        )
        return DataError(
            f"no majority of the captures agrees ({seen})",
            "Check that all show the same object turning in the configured direction, record again with more "
            "views, or enter the positions as numbers.",
        )
    reasons, remedy = [], "Omit it or record it again; nothing was stored."
    for i, (straight, mirrored, allowed) in odd.items():
        count = len(sightings[i].positions)
        if count != size:
            reason = f"shows {counted(count, 'reflector')}, the others {size}"
        elif mirrored <= allowed:
            reason = "is the mirror image of the others: the object turned the other way"
            remedy += " If the direction is not known: tagid config set tags.direction unknown."
        else:
            reason = f"has a reflector {straight * 1e3:.1f} mm from its position in the others"
        reasons.append(f"{sightings[i].name} {reason}")
    return DataError("; ".join(reasons), remedy)


def _placed(
    points: NDArray[np.float64],
    noise: NDArray[np.float64],
    mean: NDArray[np.float64],
    start: Pairing,
    scatter: float,
) -> tuple[float, NDArray[np.float64]]:
    """Rotation and shift of points (K, 2) with noise (K, 2, 2) onto the mean, by weighted least squares.

    Starts at the unweighted rotation and shift of the pairing.
    """
    turn, shift = start.rotation_rad, np.array(start.shift_m)
    for _ in range(5):
        rotation = rotation_matrix(turn)
        weight = np.linalg.inv(rotation @ noise @ rotation.T + scatter * np.eye(2))
        turned = points @ rotation.T
        residual = mean - turned - shift
        slope = np.zeros((len(points), 2, 3))
        slope[:, 0, 0], slope[:, 1, 0] = -turned[:, 1], turned[:, 0]
        slope[:, 0, 1] = slope[:, 1, 2] = 1.0
        normal = np.einsum("kia,kij,kjb->ab", slope, weight, slope)
        step = np.linalg.solve(normal, np.einsum("kia,kij,kj->a", slope, weight, residual))
        turn, shift = turn + float(step[0]), shift + step[1:]
    return turn, shift


def _excess(residuals: NDArray[np.float64], noise: NDArray[np.float64], k: int) -> float:
    """Variance per coordinate, m^2, for which the residuals (n, K, 2) of a mean have their expected size.

    Their weighted sum of squares has (n - 1) (2 K - 3) degrees of freedom: each capture uses three for its
    rotation and shift, and the mean uses what remains of one capture.
    """
    expected = (len(residuals) - 1) * (2 * k - 3)

    def total(scatter: float) -> float:
        weight = np.linalg.inv(noise + scatter * np.eye(2))
        return float(np.einsum("nki,nkij,nkj->", residuals, weight, residuals))

    low, high = 0.0, AGREE_M**2
    if total(low) <= expected:
        return low
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if total(middle) > expected else (low, middle)
    return high
