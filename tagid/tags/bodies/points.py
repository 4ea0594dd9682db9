"""Reflectors without a body: points, and the wave that goes from one reflector by another back to the radar.

Per frequency f and view v, with the room subtracted from data and columns alike,

    Y = g(f) sum_k exp(-j kappa (R_vk - d)) (d / R_vk)^2
      + h(f) sum_{i<k} exp(-j kappa ((R_vi + R_vk + D_ik) / 2 - d)) d^2 / (R_vi R_vk) D_0 / D_ik,

R_vk the distance of reflector k from the antenna and D_ik that between two reflectors. Octahedra look the
same from all sides, so g is one amplitude for all reflectors. The second sum is the double bounce: of two
octahedra of 40 mm, 64 mm apart, it holds 8 % of the echo; with it full-wave tags are explained to 0.1 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import combinations
from math import inf

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop
from tagid.tags.bodies.reflectors_fit import solve
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout

_compiled = loop("tagid.tags.bodies._points")

REACH_M = 0.14
"""Reflectors are looked for up to this distance from the axis."""
GRID_M = 0.008
MOST = 5
"""Most reflectors of another arrangement."""
APART_M = 0.02
"""Reflectors nearer than this are one."""
_SPACING_M = 0.06
_LOAD = 1e-9
_THINNED = 2


@dataclass(frozen=True)
class PointSettings:
    """Tests and priors of a tag without a body.

    Attributes:
        model_error: share of the echo that the model leaves without noise: up to 0.1 % of full-wave tags,
            1 % where reflectors differ by 0.5 dB and stand 0.5 mm off their places.
        displaced_m: an arrangement is another one where its reflectors lie further from the layout's, RMS,
        pair_m: or further than this if there are two. The spacing is all that a pair shows: on a ring of
            45 mm, reflectors 150 degrees apart are only 3 mm closer than opposite ones,
        wobble_rad: where the pair's angle has no error: a turntable's wobble of 0.01 rad moves two directions
            apart by up to twice that.
        sigmas: standard deviations of the measured places that are added,
        pair_sigmas: or of a pair's. Pairs of a ring crowd at its diameter (their spacings follow the arcsine
            law), where another pair is as likely as the opposite one from 2 standard deviations on.
        noise_sigmas: so many standard deviations of the noise's energy are no error of the model.
        unexplained: largest share of the echo that a layout may leave.
        lead: smallest lead, see `PointReading.lead`.
        noise_nats: lead in noise variances that counts as much as the model's own error.
        layouts: layouts fitted, the best of the reading without double bounce.
    """

    model_error: float = 0.01
    displaced_m: float = 0.004
    pair_m: float = 0.4e-3
    wobble_rad: float = 0.02
    sigmas: float = 3.0
    pair_sigmas: float = 2.0
    noise_sigmas: float = 2.0
    unexplained: float = 0.05
    lead: float = 0.5
    noise_nats: float = 25.0
    layouts: int = 3

    def limit_m(self, points: PlacedPoints, error_m: float, layout: Layout) -> float:
        """Largest RMS distance of measured reflectors from a layout that they belong to, m.

        Args:
            points: as measured.
            error_m: of a place, from what points do not explain.
            layout: the layout.
        """
        built, sigmas = self.displaced_m, self.sigmas
        if len(points.places) == 2:
            sigmas = self.pair_sigmas
            # The middle's distance is the lever by which their angle changes each one's distance from it.
            lever = float(np.hypot(*layout.positions[:, :2].mean(axis=0)))
            built = float(np.hypot(self.pair_m, lever * self.wobble_rad / 2))
        return float(np.sqrt(built**2 + (sigmas * points.spread_m) ** 2 + error_m**2))


@dataclass(frozen=True, eq=False)
class PlacedPoints:
    """An arrangement after its fit.

    Attributes:
        places: (K,) complex128 x + jy, m.
        heights: (K,) above the object's plane, m.
        left: energy left.
        layout: its name; None for places that no layout has.
        spread: computes `spread_m`; None for a layout, whose shape is fixed.
    """

    places: NDArray[np.complex128]
    heights: NDArray[np.float64]
    left: float
    layout: str | None = None
    spread: Callable[[], float] | None = None

    @cached_property
    def spread_m(self) -> float:
        """Standard deviation of a reflector's place about the others, RMS, m; 0 for a layout.

        The Cramer-Rao bound, with the model's own error as noise, and at least what is left.
        """
        return self.spread() if self.spread is not None else 0.0


@dataclass(frozen=True, eq=False)
class PointReading:
    """What the scans say of a tag without a body.

    Attributes:
        layouts: fitted layouts, best first.
        free: the best layout's reflectors, each free.
        others: arrangements that are not the best layout's, best first.
        tag: energy above noise.
        noise: energy of the noise.
        unexplained: share of it that the best layout leaves.
        least: share of it that the best arrangement of any kind leaves.
        lead: what the best other arrangement leaves more, over what the layout leaves, the model's error and
            the noise.
        displaced_m: RMS distance of the free reflectors from the layout's, m.
        limit_m: the largest that the resolution and the layout's tolerance allow, m.
    """

    layouts: tuple[PlacedPoints, ...]
    free: PlacedPoints
    others: tuple[PlacedPoints, ...]
    tag: float
    noise: float
    unexplained: float
    least: float
    lead: float
    displaced_m: float
    limit_m: float

    @property
    def snr_db(self) -> float:
        """Energy above the noise over that of the noise, dB."""
        return float(10 * np.log10(max(self.tag / max(self.noise, 1e-30), 1e-9)))

    def passes(self, settings: PointSettings) -> bool:
        """Whether the best layout may be named."""
        return self.unexplained <= settings.unexplained and self.lead >= settings.lead

    def displaced(self, settings: PointSettings) -> bool:
        """Whether the layout's reflectors explain the echo, but in other places than the layout's."""
        return self.least <= settings.unexplained and self.displaced_m > self.limit_m


@dataclass(frozen=True)
class Place:
    """Where a layout may lie: turn, rad, and centre, m."""

    layout: Layout
    turn_rad: float
    centre_m: tuple[float, float]


def columns(
    spectra: Spectra, places: NDArray[np.complex128], heights: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """(F, 1 or 2, V) of the model, centred: the points, and the double bounce where there are two or more."""
    return centred(_waves(spectra, places, heights).columns)


def tapered_left(spectra: Spectra, placed: PlacedPoints, centre: complex) -> float:
    """Energy that points leave where they may be brighter or darker from outside than from behind.

    Per frequency the points have two amplitudes, for 1 and for cos psi, psi the angle between their outward
    direction and that of the antenna, beside the double bounce.

    Args:
        spectra: the scans.
        placed: the points.
        centre: of the object, from which they point outward, x + jy, m.
    """
    across = spectra.antenna[None] - placed.places[:, None]
    distance = np.hypot(np.abs(across), spectra.height_m[None] - placed.heights[:, None])
    single = spectra.waves(distance) * (spectra.distance_m / distance) ** 2
    outward = np.angle(across) - np.angle(placed.places - centre)[:, None]
    tapered = centred((single * np.cos(outward)).sum(axis=1, keepdims=True))
    cols = np.concatenate([columns(spectra, placed.places, placed.heights), tapered], axis=1)
    return float(solve(spectra.data, cols[None]).left[0])


@dataclass(frozen=True, eq=False)
class _Waves:
    """Columns (F, C, V), not centred, and their derivatives (2 K, F, C, V) with every reflector's x and y."""

    columns: NDArray[np.complex128]
    slopes: NDArray[np.complex128]


def _waves(
    spectra: Spectra, places: NDArray[np.complex128], heights: NDArray[np.float64], slopes: bool = False
) -> _Waves:
    across = spectra.antenna[None] - places[:, None]
    flat = np.abs(across)
    distance = np.hypot(flat, spectra.height_m[None] - heights[:, None])
    single = spectra.waves(distance) * (spectra.distance_m / distance) ** 2
    count = len(places)
    pairs = list(combinations(range(count), 2))
    f, v = len(spectra.wavenumbers), spectra.views
    out = np.zeros((f, 2 if pairs else 1, v), dtype=np.complex128)
    out[:, 0] = single.sum(axis=1)
    change = np.zeros((2 * count if slopes else 0, *out.shape), dtype=np.complex128)
    turn = -1j * spectra.wavenumbers[:, None]
    # dR / dx and dR / dy, (K, V).
    toward = (-across.real / distance, -across.imag / distance)
    if slopes:
        for k in range(count):
            for axis in (0, 1):
                change[2 * k + axis, :, 0] = turn * single[:, k] * toward[axis][k]
    for i, k in pairs:
        gap = places[i] - places[k]
        apart = float(np.hypot(abs(gap), heights[i] - heights[k]))
        apart = max(apart, 1e-3)
        path = (distance[i] + distance[k] + apart) / 2
        spread = spectra.distance_m**2 / (distance[i] * distance[k]) * _SPACING_M / apart
        wave = spectra.waves(path) * spread
        out[:, 1] += wave
        if slopes:
            for axis, along in ((0, gap.real / apart), (1, gap.imag / apart)):
                change[2 * i + axis, :, 1] += turn * wave * (toward[axis][i] + along) / 2
                change[2 * k + axis, :, 1] += turn * wave * (toward[axis][k] - along) / 2
    return _Waves(out, change)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Places (G,) within REACH_M, their waves (F, G, V) at every `_THINNED`-th frequency, energies (F, G).

    In single precision: a place that is 8 mm from the next one is all that is asked for.
    """

    places: NDArray[np.complex128]
    waves: NDArray[np.complex64]
    energies: NDArray[np.float64]

    @classmethod
    def of(cls, spectra: Spectra) -> _Grid:
        """The grid of some scans; the last one is kept for others that see it from the same places."""
        thin = spectra.thinned(_THINNED)
        return _grid_of(thin.antenna.tobytes(), thin.wavenumbers.tobytes(), thin.distance_m)


@lru_cache(maxsize=1)
def _grid_of(antenna: bytes, wavenumbers: bytes, distance_m: float) -> _Grid:
    """`_Grid.of` for antenna positions (V,) complex128, m, and wavenumbers (F,) float64, rad/m."""
    line = np.arange(-REACH_M, REACH_M + GRID_M / 2, GRID_M)
    places = (line[:, None] + 1j * line[None]).ravel()
    places = places[np.abs(places) <= REACH_M]
    kappa, seen_from = np.frombuffer(wavenumbers), np.frombuffer(antenna, dtype=np.complex128)
    none = np.zeros((len(kappa), len(seen_from)), dtype=np.complex128)
    spectra = Spectra(none, kappa, seen_from, np.zeros(len(seen_from)), distance_m, 0.0)
    waves = centred(spectra.waves(np.abs(seen_from[None] - places[:, None])))
    energies = (waves.real**2 + waves.imag**2).sum(axis=2)
    found = _Grid(places, waves.astype(np.complex64), np.maximum(energies, 1e-9))
    for shared in (found.places, found.waves, found.energies):
        shared.flags.writeable = False
    return found


@dataclass(frozen=True, eq=False)
class _Linear:
    """The model at one arrangement, amplitudes eliminated (Kaufman 1975).

    Attributes:
        left: energy left.
        normal: (2 K, 2 K) real inner products of the slopes along every reflector's x and y.
        gradient: (2 K,) those of the slopes with what is left.
    """

    left: float
    normal: NDArray[np.float64]
    gradient: NDArray[np.float64]


_FARTHEST_M, _LONGEST_M = REACH_M + 0.02, 0.02
"""A fit's points stay within this distance of the axis, and move no further in one step along x or y."""
_MOST_COMPILED = 16
"""Points that the compiled model takes, at most."""


class PointFitter:
    """Fits arrangements of points to spectra.

    Args:
        spectra: the scans.
        variance: of one value's error: noise, and the model's own error.
    """

    def __init__(self, spectra: Spectra, variance: float) -> None:
        self.spectra = spectra
        self.variance = variance

    @cached_property
    def grid(self) -> _Grid:
        """Where further reflectors are looked for."""
        return _Grid.of(self.spectra)

    def rest(self, places: NDArray[np.complex128], heights: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(F, V) what an arrangement leaves of the data."""
        return self._solved(columns(self.spectra, places, heights))[0]

    def rigid(self, at: Place, rounds: int = 8) -> PlacedPoints:
        """A layout near a place, free in turn and centre."""
        positions = at.layout.placed(at.turn_rad, np.asarray(at.centre_m))
        places = np.asarray(positions[:, 0] + 1j * positions[:, 1])
        return self._fitted(places, np.asarray(at.layout.heights, dtype=np.float64), rounds, at.layout.name)

    def free(
        self, places: NDArray[np.complex128], heights: NDArray[np.float64], rounds: int = 8
    ) -> PlacedPoints:
        """Points near given places, each free."""
        return self._fitted(places, heights, rounds, None)

    def _solved(
        self, cols: NDArray[np.complex128]
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
        """What columns leave of the data (F, V), their amplitudes (F, C), an orthonormal basis (F, V, C)."""
        tall = np.swapaxes(cols, 1, 2)
        q, r = np.linalg.qr(tall)
        inner = (q.conj().swapaxes(1, 2) @ self.spectra.data[..., None])[..., 0]
        load = _LOAD * np.abs(r).max(axis=(1, 2), keepdims=True) + 1e-300
        amplitudes = np.linalg.solve(r + load * np.eye(r.shape[-1]), inner[..., None])[..., 0]
        rest = self.spectra.data - (q @ inner[..., None])[..., 0]
        return rest, np.asarray(amplitudes, dtype=np.complex128), np.asarray(q, dtype=np.complex128)

    def _fitted(
        self,
        places: NDArray[np.complex128],
        heights: NDArray[np.float64],
        rounds: int,
        name: str | None,
    ) -> PlacedPoints:
        """Levenberg-Marquardt with the amplitudes eliminated (Kaufman 1975), free where no name is given."""
        if _compiled is not None and len(places) <= _MOST_COMPILED:
            places, at = self._descended(places, heights, rounds, rigid=name is not None)
        else:
            places, at = self._descended_slowly(places, heights, rounds, rigid=name is not None)
        if name:
            return PlacedPoints(places, heights, at.left, name)
        scale = float(np.sqrt(max(at.left / (self.variance * self.spectra.data.size), 1.0)))
        return PlacedPoints(places, heights, at.left, None, partial(self._spread, places, at.normal, scale))

    def _descended(
        self, places: NDArray[np.complex128], heights: NDArray[np.float64], rounds: int, *, rigid: bool
    ) -> tuple[NDArray[np.complex128], _Linear]:
        """Where the compiled loop ends, and the model there."""
        size = 2 * len(places)
        found, left, normal, gradient = _plain(places), np.empty(1), np.empty((size, size)), np.empty(size)
        tables = self.spectra.tables
        freedom = (int(rigid), rounds, _FARTHEST_M, _LONGEST_M)
        there = tables.antenna, tables.height, tables.data, tables.scalars
        _compiled.fit(*there, freedom, found, np.ascontiguousarray(heights), left, normal, gradient)
        return found[0::2] + 1j * found[1::2], _Linear(float(left[0]), normal, gradient)

    def _descended_slowly(
        self, places: NDArray[np.complex128], heights: NDArray[np.float64], rounds: int, *, rigid: bool
    ) -> tuple[NDArray[np.complex128], _Linear]:
        """The same by numpy."""
        at, damping = self._linear(places, heights), 1e-3
        for _ in range(rounds):
            steps = _moves(places) if rigid else np.eye(2 * len(places))
            normal, gradient = steps @ at.normal @ steps.T, steps @ at.gradient
            gain = 0.0
            for _ in range(4):
                load = damping * np.diag(normal) + 1e-12 * np.trace(normal) + 1e-300
                step = np.asarray(np.linalg.solve(normal + np.diag(load), gradient), dtype=np.float64)
                trial = _moved(places, step) if rigid else places + step[0::2] + 1j * step[1::2]
                longest = np.abs(_plain(trial - places)).max()
                if np.abs(trial).max() < _FARTHEST_M and longest < _LONGEST_M:
                    after = self._linear(trial, heights)
                    if after.left < at.left:
                        gain, places, at = at.left - after.left, trial, after
                        damping /= 5
                        break
                damping *= 8
            if gain < 1e-4 * at.left:
                break
        return places, at

    def _linear(self, places: NDArray[np.complex128], heights: NDArray[np.float64]) -> _Linear:
        """The model at an arrangement."""
        waves = _waves(self.spectra, places, heights, slopes=True)
        rest, amplitudes, q = self._solved(centred(waves.columns))
        slope = centred(np.einsum("pfcv,fc->pfv", waves.slopes, amplitudes))
        slope = slope - (q @ (q.conj().swapaxes(1, 2) @ slope[..., None]))[..., 0]
        flat = slope.reshape(2 * len(places), -1)
        gradient = np.real(flat.conj() @ rest.ravel())
        return _Linear(float(np.sum(np.abs(rest) ** 2)), np.real(flat.conj() @ flat.T), gradient)

    def _spread(self, places: NDArray[np.complex128], normal: NDArray[np.float64], scale: float) -> float:
        """`PlacedPoints.spread_m`, from the Fisher information of the places, amplitudes eliminated."""
        information = 2 / self.variance * normal
        load = 1e-9 * np.trace(information) * np.eye(len(information))
        covariance = np.linalg.inv(information + load)
        rigid = np.linalg.qr(_moves(places).T)[0]
        shape = np.eye(len(information)) - rigid @ rigid.T
        return scale * float(np.sqrt(max(np.trace(shape @ covariance @ shape), 0.0) / len(places)))


def _moves(places: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(3, 2 K) directions of points that move as a whole: along x and y, and turning about their middle."""
    unit = np.ones(len(places), dtype=np.complex128)
    return np.stack([_plain(unit), _plain(1j * unit), _plain(1j * (places - places.mean()))])


def _moved(places: NDArray[np.complex128], step: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Points after a step (3,) along `_moves`: the turn is a whole one, as its tangent would stretch them."""
    middle = places.mean()
    return np.asarray(middle + complex(step[0], step[1]) + (places - middle) * np.exp(1j * step[2]))


def _plain(places: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(2 K,) x and y, one after the other."""
    return np.array(places, dtype=np.complex128).view(np.float64)


def displaced(one: NDArray[np.complex128], other: NDArray[np.complex128]) -> float:
    """RMS distance of two sets of places after the best turn and shift, m; infinite for unlike counts."""
    if len(one) != len(other):
        return float("inf")
    a, b = one - one.mean(), other - other.mean()
    # Reflectors of the second set nearest to those of the first: both come from fits that began there.
    order = [int(np.argmin(np.abs(b - z))) for z in a]
    if len(set(order)) < len(order):
        return float("inf")
    b = b[order]
    turn = np.exp(1j * np.angle(np.vdot(b, a)))
    return float(np.sqrt(np.mean(np.abs(a - turn * b) ** 2)))


def read_points(
    spectra: Spectra,
    places: Sequence[Place],
    found: NDArray[np.complex128],
    settings: PointSettings,
) -> PointReading:
    """The best layout without a body, against every other arrangement of points near what is seen.

    Args:
        spectra: the scans.
        places: where each layout may lie, the best first.
        found: (N,) x + jy of reflectors that were found without a layout, the strongest first, m.
        settings: see there.
    """
    noise = _noise_after(spectra)
    tag = max(spectra.energy - spectra.noise_energy, 1e-30)
    variance = max(spectra.noise, 1e-12 * tag / spectra.data.size)
    variance += settings.model_error * tag / spectra.data.size
    fitter = PointFitter(spectra, variance)
    layouts = sorted((fitter.rigid(place) for place in places[: settings.layouts]), key=lambda p: p.left)
    best = layouts[0]
    rivals = [fitter.free(best.places, best.heights)]
    if len(layouts) > 1:
        rivals.append(fitter.free(layouts[1].places, layouts[1].heights))
    seen: list[complex] = []
    for place in found:
        if abs(place) < REACH_M and all(abs(place - other) > APART_M for other in seen):
            seen.append(complex(place))
    for count in range(1, min(len(seen), MOST) + 1):
        rivals.append(fitter.free(np.array(seen[:count]), np.zeros(count), 6))
    rivals += [_joined(fitter, rivals[0]), _joined(fitter, min(rivals, key=lambda p: p.left))]
    own = next(place.layout for place in places if place.layout.name == best.layout)

    def limit_m(p: PlacedPoints) -> float:
        return settings.limit_m(p, _error_m(spectra, p, settings), own)

    # Double bounce has an amplitude per frequency, which one reflector does without. A round body near its
    # own centre is one point.
    bounce = spectra.amplitude_cost

    def charged(p: PlacedPoints) -> float:
        return p.left + bounce * (len(p.places) > 1)

    def is_other(p: PlacedPoints) -> bool:
        # Most have another number of points, for which nobody need ask how well their places are known.
        away = displaced(best.places, p.places)
        return away == inf or away > limit_m(p)

    others = [p for p in rivals if is_other(p)]
    others += layouts[1:]
    others.sort(key=charged)
    above = max(best.left - noise, 0.0)
    error = above + settings.model_error * tag + settings.noise_nats * spectra.noise
    least = min(p.left for p in (best, *rivals))
    following = charged(others[0]) if others else spectra.energy
    return PointReading(
        tuple(layouts),
        rivals[0],
        tuple(others),
        tag,
        spectra.noise_energy,
        above / tag,
        max(least - noise, 0.0) / tag,
        (following - charged(best)) / error,
        displaced(best.places, rivals[0].places),
        limit_m(rivals[0]),
    )


def _noise_after(spectra: Spectra) -> float:
    """Expected energy of the noise after the fit of two amplitudes per frequency."""
    return spectra.noise_energy * max(spectra.views - 3, 1) / max(spectra.views - 1, 1)


def _error_m(spectra: Spectra, points: PlacedPoints, settings: PointSettings) -> float:
    """How far what points leave may have moved them: the root of its share is an error of the phase.

    The energy of n values of noise varies by n^-1/2 of itself, and its level is known to n^-1/2 / ln 2 from
    the median of about as many.
    """
    doubt = settings.noise_sigmas * np.hypot(1, 1 / np.log(2)) / np.sqrt(spectra.data.size)
    tag = max(spectra.energy - spectra.noise_energy, 1e-30)
    share = max(points.left - (1 + doubt) * _noise_after(spectra), 0.0) / tag
    return float(np.sqrt(share) / spectra.wavenumbers.mean())


def _joined(fitter: PointFitter, base: PlacedPoints) -> PlacedPoints:
    """An arrangement with one reflector more, where most of what it leaves comes from."""
    rest = fitter.rest(base.places, base.heights)
    grid = fitter.grid
    seen = (grid.waves @ rest[::_THINNED].conj().astype(np.complex64)[..., None])[..., 0]
    power = seen.real.astype(np.float64) ** 2 + seen.imag.astype(np.float64) ** 2
    power = (power / grid.energies).sum(axis=0)
    power[np.abs(grid.places[:, None] - base.places[None]).min(axis=1) <= APART_M] = -1.0
    place = grid.places[int(np.argmax(power))]
    return fitter.free(np.append(base.places, place), np.append(base.heights, 0.0), 6)
