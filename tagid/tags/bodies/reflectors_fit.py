"""Alike reflectors on a body: one complex pattern for all of them, and the fit of their places.

Per frequency f and view v, with the room subtracted from data and columns alike,

    Y = A echo(body) + sum_p g_p sum_k w_p(psi_vk) exp(-j kappa (R_vk - d)) (d / R_vk)^2,
    w_p(psi) = ((1 + cos psi) / 2)^t cos(p psi),  p < M,

psi_vk the angle between reflector k's outward direction and the antenna, R_vk their distance. A and g_p are
free per frequency and solved by linear least squares inside (variable projection, Golub and Pereyra 1973), so
what is searched is where the reflectors are: centre, radius and angles. One pattern for all, symmetric about
the outward direction, is what makes them alike. Every term more makes it easier for one reflector to imitate
two, so terms are charged for. A tag on metal needs 3; on a ceramic cup, which focuses the wave on what is
behind it, 5; before a helmet's shell, larger and further from its reflectors, 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.compiled import Arrangements
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Pose
from tagid.tags.bodies.spectra import Spectra, centred

_LOAD = 1e-6
_BODY_STEPS = (2e-5, 2e-5, 5e-4)
"""Finite differences of a body's centre in x and y, m, and of its turn, rad."""
COMMON = 6
"""Coordinates before the reflectors' angles."""


@dataclass(frozen=True)
class Pattern:
    """A family of reflector patterns.

    Attributes:
        tilt: t, 2 for a reflector before an opaque body, 0 for one that is seen from all sides.
        terms: M, 1 to 7.
    """

    tilt: int
    terms: int


FACING = Pattern(2, 3)
OPEN = Pattern(0, 3)
THROUGH = Pattern(0, 5)
RICH = Pattern(0, 7)
POINTS = Pattern(0, 1)
FEWEST_TERMS = 2
"""Of the patterns that are compared on a body."""


def behind(amplitudes: NDArray[np.complex128], tilt: float) -> float:
    """Amplitude of a pattern from behind over that from in front, RMS over frequency and 50 degrees about.

    Args:
        amplitudes: (F, M) g_p of its terms.
        tilt: t.
    """
    near = np.linspace(0, np.deg2rad(50.0), 8)
    psi = np.concatenate([near, np.pi - near])
    sides = ((1 + np.cos(psi)) / 2) ** tilt * np.cos(np.arange(amplitudes.shape[1])[:, None] * psi)
    front, back = np.split((np.abs(amplitudes @ sides) ** 2).sum(axis=0), 2)
    return float(np.sqrt(back.sum() / max(float(front.sum()), 1e-300)))


@dataclass(frozen=True)
class Priors:
    """What is known before the scans, standard deviations in metres.

    Attributes:
        centre_m: the body's centre about the rotation axis.
        radius_m: a reflector's apparent radius about its nominal one: the bounce between wall and reflector
            moves it by -13 to +22 mm on metal cans.
        radius_low_m, radius_high_m: limits of that difference.
        model_error: share of the explained echo that the model leaves even without noise.
    """

    centre_m: float = 8e-3
    radius_m: float = 12e-3
    radius_low_m: float = -18e-3
    radius_high_m: float = 27e-3
    model_error: float = 0.005


@dataclass(frozen=True, eq=False)
class Batch:
    """H arrangements of up to K reflectors, each with its place and its way of moving.

    Attributes:
        at: (H, 6 + K) ring centre x and y, radius offset, body centre x and y, body turn, reflector angles.
        radii: (H, K) reflectors' distances from the ring's centre, m.
        heights: (H, K) above the object's plane, m.
        present: (H, K) 1 where there is a reflector, 0 where the row has fewer.
        lean: (H, K) from its direction on the ring to its outward direction, rad: the normal of a flat face
            is the same for all that stand on it.
        tilt: (H,) t of the pattern.
        terms: (H,) M of the pattern.
        moves: (H, P, 6 + K) directions that the fit may take.
        low, high: (H,) limits of the radius offset, m.
        prior_radius: (H,) expected radius offset, m.
    """

    at: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    present: NDArray[np.float64]
    lean: NDArray[np.float64]
    tilt: NDArray[np.float64]
    terms: NDArray[np.float64]
    moves: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    prior_radius: NDArray[np.float64]

    @classmethod
    def at_rest(
        cls,
        at: NDArray[np.float64],
        radii: NDArray[np.float64],
        heights: NDArray[np.float64],
        pattern: Pattern,
    ) -> Batch:
        """One arrangement that no fit moves: coordinates (1, 6 + K), radii and heights (K,), m."""
        k, one = len(radii), np.ones(1)
        return cls(
            at,
            radii[None].copy(),
            heights[None].copy(),
            np.ones((1, k)),
            np.zeros((1, k)),
            one * pattern.tilt,
            one * pattern.terms,
            np.zeros((1, 1, COMMON + k)),
            -one,
            one,
            0 * one,
        )

    def moved(self, at: NDArray[np.float64]) -> Batch:
        """The same arrangements elsewhere."""
        return replace(self, at=at)

    def some(self, rows: NDArray[np.intp]) -> Batch:
        """Some rows only."""
        return Batch(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def rows(self) -> Arrangements:
        """The same for the compiled loop."""
        return Arrangements(
            self.at, self.radii, self.heights, self.present, self.lean, self.tilt, self.terms, self.moves
        )

    @property
    def angles(self) -> NDArray[np.float64]:
        """(H, K) directions of the reflectors from the ring's centre, rad."""
        return self.at[:, COMMON:]

    @property
    def centres(self) -> NDArray[np.complex128]:
        """(H,) ring centres, x + jy, m."""
        return np.asarray(self.at[:, 0] + 1j * self.at[:, 1])


def joined(batches: list[Batch]) -> Batch:
    """Batches one after the other, padded to the largest number of reflectors and moves."""
    rows = sum(len(b.at) for b in batches)
    k = max(b.radii.shape[1] for b in batches)
    p = max(b.moves.shape[1] for b in batches)
    wide = {
        "radii": (k,),
        "heights": (k,),
        "present": (k,),
        "lean": (k,),
        "at": (COMMON + k,),
        "moves": (p, COMMON + k),
    }
    whole = {name: np.zeros((rows, *wide.get(name, ()))) for name in Batch.__dataclass_fields__}
    first = 0
    for batch in batches:
        last = first + len(batch.at)
        for name, target in whole.items():
            part = getattr(batch, name)
            target[(slice(first, last), *(slice(n) for n in part.shape[1:]))] = part
        first = last
    return Batch(**whole)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of the linear model at the places of a batch, and what their derivatives need.

    Attributes:
        values: (H, F, 1 + M, V) of the body and of the pattern's terms, M the most of any row, centred over
            the views; those that a row has not are zero.
        body: (H, F, V) the body's echo, not centred; None for none.
        waves: (H, F, K, V) each reflector's wave with its weight, without the pattern's terms.
        cosine: (H, K, V) of the angle between outward direction and antenna.
        toward: (H, K, V) complex, from reflector to antenna in the plane, turned so that outward is real, m.
        distance: (H, K, V) from reflector to antenna, m.
        facing: (H, K, V) weight of the tilt.
    """

    values: NDArray[np.complex128]
    body: NDArray[np.complex128] | None
    waves: NDArray[np.complex128]
    cosine: NDArray[np.float64]
    toward: NDArray[np.complex128]
    distance: NDArray[np.float64]
    facing: NDArray[np.float64]

    @classmethod
    def of(cls, spectra: Spectra, body: BodyModel | None, batch: Batch) -> Columns:
        """Columns of every row."""
        at = batch.at
        ring = (spectra.antenna[None] - batch.centres[:, None])[:, None]
        radius = (batch.radii + at[:, 2:3])[..., None]
        toward = ring * np.exp(-1j * batch.angles)[..., None] - radius
        plane = np.abs(toward)
        cosine = (toward * np.exp(-1j * batch.lean)[..., None]).real / plane
        distance = np.hypot(plane, spectra.height_m - batch.heights[..., None])
        facing = np.where(batch.tilt[:, None, None] > 0, ((1 + cosine) / 2) ** 2, 1.0)
        weight = facing * (spectra.distance_m / distance) ** 2 * batch.present[..., None]
        waves = np.moveaxis(spectra.waves(distance) * weight, 0, 1)
        h, f, v = len(at), len(spectra.wavenumbers), spectra.views
        most = int(batch.terms.max())
        values = np.zeros((h, f, 1 + most, v), dtype=np.complex128)
        echo = None
        if body is not None:
            echo = body.echo(spectra, at[:, 3] + 1j * at[:, 4], at[:, 5])
            values[:, :, 0] = echo
        values[:, :, 1] = waves.sum(axis=2)
        if most > 1:
            # cos(p psi) by Chebyshev's recurrence.
            before, now = waves, waves * cosine[:, None]
            twice = 2 * cosine[:, None]
            for p in range(2, most + 1):
                values[:, :, p] = now.sum(axis=2) * (batch.terms >= p)[:, None, None]
                if p < most:
                    before, now = now, twice * now - before
        return cls(centred(values), echo, waves, cosine, toward, distance, facing)


@dataclass(frozen=True, eq=False)
class Solved:
    """Amplitudes of columns and what they leave.

    Attributes:
        amplitudes: (H, F, C) least-squares amplitudes.
        rest: (H, F, V) what they leave of the data.
        left: (H,) its energy.
        gram: (H, F, C, C) the columns' inner products, loaded.
    """

    amplitudes: NDArray[np.complex128]
    rest: NDArray[np.complex128]
    left: NDArray[np.float64]
    gram: NDArray[np.complex128]


def solve(data: NDArray[np.complex128], cols: NDArray[np.complex128]) -> Solved:
    """Linear least squares of data (F, V) on columns (H, F, C, V), loaded by 1e-6 of each column's energy."""
    gram = cols.conj() @ np.swapaxes(cols, -1, -2)
    right = cols.conj() @ data[None, :, :, None]
    size = np.real(np.diagonal(gram, axis1=-2, axis2=-1))
    load = _LOAD * size + np.where(size > 1e-9 * size.max(axis=-1, keepdims=True), 0, 1.0)
    gram = gram + load[..., None] * np.eye(cols.shape[2])
    amplitudes = np.asarray(np.linalg.solve(gram, right)[..., 0], dtype=np.complex128)
    rest = np.asarray(data[None] - (amplitudes[..., None, :] @ cols)[..., 0, :], dtype=np.complex128)
    left = (rest.real**2 + rest.imag**2).sum(axis=(-1, -2))
    return Solved(amplitudes, rest, left, gram)


def alone(spectra: Spectra, body: BodyModel, pose: Pose) -> Candidate:
    """A pose with what the body alone leaves there."""
    echo = body.echo(spectra, np.array([pose.centre]), np.array([pose.turn_rad]))
    return Candidate(pose, float(solve(spectra.data, centred(echo)[:, :, None]).left[0]))


@dataclass(frozen=True, eq=False)
class Linear:
    """The model at the places of a batch, amplitudes eliminated.

    Attributes:
        left: (H,) energies left.
        normal: (H, P, P) real inner products of the slopes along every move.
        gradient: (H, P) those of the slopes with what is left.
    """

    left: NDArray[np.float64]
    normal: NDArray[np.float64]
    gradient: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fitter:
    """Fits batches of arrangements on one body to spectra.

    Attributes:
        spectra: the scans.
        body: the body under the reflectors; None for bare ones.
        priors: see `Priors`.
        variance: of one value's error in the fit: noise, and the model's own error.
        body_at: (3,) expected body centre and turn where the body has a pose of its own; None otherwise.
    """

    spectra: Spectra
    body: BodyModel | None
    priors: Priors
    variance: float
    body_at: NDArray[np.float64] | None = None

    def left(self, batch: Batch) -> NDArray[np.float64]:
        """(H,) energy left at the places of a batch."""
        rows = batch.rows
        if rows.fits():
            return rows.left(self.spectra.tables, self._echoes(batch, moved=False), np.array(_BODY_STEPS))
        return solve(self.spectra.data, Columns.of(self.spectra, self.body, batch).values).left

    def fitted(self, batch: Batch, rounds: int = 6) -> tuple[Batch, NDArray[np.float64]]:
        """Levenberg-Marquardt on all rows at once; the places found and the energies left there.

        Rows that a round does not improve keep their place and try a shorter step.
        """
        at = batch.at.copy()
        damping = np.full(len(at), 1e-2)
        now = self._linear(batch)
        left, normal, gradient = now.left, now.normal, now.gradient
        cost = self._cost(batch, at, left)
        for turn in range(rounds):
            step = self._step(batch, at, normal, gradient, damping)
            trial = at + np.einsum("hp,hpk->hk", step, batch.moves)
            trial[:, 2] = np.clip(trial[:, 2], batch.low, batch.high)
            last = turn == rounds - 1
            moved = batch.moved(trial)
            there = None if last else self._linear(moved)
            trial_left = self.left(moved) if there is None else there.left
            trial_cost = self._cost(batch, trial, trial_left)
            better = trial_cost < cost
            at[better], left[better], cost[better] = trial[better], trial_left[better], trial_cost[better]
            if there is not None:
                normal[better], gradient[better] = there.normal[better], there.gradient[better]
            damping = np.where(better, damping / 5, damping * 8)
        return batch.moved(at), left

    def _linear(self, batch: Batch) -> Linear:
        """The model at the places of a batch.

        The slope is that of Kaufman (1975): derivatives of the columns at fixed amplitudes, projected.
        """
        rows = batch.rows
        if rows.fits():
            steps = np.array(_BODY_STEPS)
            return Linear(*rows.linear(self.spectra.tables, self._echoes(batch, moved=True), steps))
        cols = Columns.of(self.spectra, self.body, batch)
        return self._along(batch, cols, solve(self.spectra.data, cols.values), cols.values)

    def _along(self, batch: Batch, cols: Columns, solved: Solved, values: NDArray[np.complex128]) -> Linear:
        """The model along every move, from amplitudes (H, F, 1 + M) of the pattern's cosines.

        Args:
            batch, cols: the places, and the columns there.
            solved: what was solved on `values`, with the amplitudes of the columns' own terms.
            values: (H, F, C, V) the columns that were solved for.
        """
        slope = self._reflector_slopes(batch, cols, solved) + self._body_slopes(batch, cols, solved)
        slope -= slope.mean(axis=-1, keepdims=True)
        along = np.linalg.solve(solved.gram, values.conj() @ np.swapaxes(slope, -1, -2))
        # Real parts of inner products: those of real and imaginary parts side by side.
        plain = (np.swapaxes(along, -1, -2) @ values - slope).view(np.float64)
        normal = (plain @ np.swapaxes(plain, -1, -2)).sum(axis=1)
        gradient = (plain @ solved.rest.view(np.float64)[..., None])[..., 0].sum(axis=1)
        return Linear(solved.left, normal, gradient)

    def _echoes(self, batch: Batch, *, moved: bool) -> NDArray[np.complex128]:
        """(B, H, F, V) the body's echo at its places, and moved along each coordinate; B = 0 for none.

        With `moved` false only at its places.
        """
        if self.body is None:
            return np.zeros((0, len(batch.at), *self.spectra.data.shape), dtype=np.complex128)
        there = batch.at[None, :, 3:6]
        if moved:
            count = 3 if self.body.turns else 2
            ahead = np.concatenate([np.zeros((1, 3)), np.diag(_BODY_STEPS)[:count]])
            there = there + ahead[:, None]
        flat = there.reshape(-1, 3)
        echoes = self.body.echo(self.spectra, flat[:, 0] + 1j * flat[:, 1], flat[:, 2])
        return np.asarray(echoes.reshape(*there.shape[:2], *self.spectra.data.shape))

    def _reflector_slopes(self, batch: Batch, cols: Columns, solved: Solved) -> NDArray[np.complex128]:
        """(H, F, P, V) derivative of the reflectors' echo along every move.

        A move displaces every reflector against the antenna by a constant vector, where it shifts or widens
        the ring, and across its distance from the ring's centre, where it turns. So the slopes of all moves
        are combinations of three of each reflector: of its own x, outward, of its y, and of its angle.
        """
        c, terms = cols.cosine, solved.amplitudes.shape[2] - 1
        shapes = _chebyshev(c, terms)
        h, _, _, k, v = shapes.shape
        mixed = solved.amplitudes[:, None, :, 1:] @ shapes.reshape(h, 2, terms, k * v)
        pattern, steeper = np.moveaxis(mixed.reshape(h, 2, -1, k, v), 1, 0)
        steeper = (
            steeper + pattern * (np.where(batch.tilt > 0, 2.0, 0.0)[:, None, None] / (1.02 + c))[:, None]
        )
        phase = pattern * cols.waves * (-1j * self.spectra.wavenumbers[:, None, None])
        steeper = steeper * cols.waves
        plane = np.abs(cols.toward)
        # Of a unit displacement along x and y: the change of the distance, and of the cosine.
        out, side = cols.toward.real / plane, cols.toward.imag / plane
        longer = plane / cols.distance
        ahead, across = np.cos(batch.lean)[..., None], np.sin(batch.lean)[..., None]
        along_x = phase * (out * longer)[:, None] + steeper * ((ahead - c * out) / plane)[:, None]
        along_y = phase * (side * longer)[:, None] + steeper * ((across - c * side) / plane)[:, None]
        reach = cols.toward + (batch.radii + batch.at[:, 2:3])[..., None]
        along_angle = along_x * reach.imag[:, None] - along_y * reach.real[:, None]
        basis = np.concatenate([along_x, along_y, along_angle], axis=2)
        shift = batch.moves[:, :, 0] + 1j * batch.moves[:, :, 1]
        local = -shift[..., None] * np.exp(-1j * batch.angles)[:, None]
        weights = np.concatenate(
            [local.real - batch.moves[:, :, 2, None], local.imag, batch.moves[:, :, COMMON:]], axis=2
        )
        # Real weights: real and imaginary parts side by side.
        return np.asarray((weights[:, None] @ basis.view(np.float64)).view(np.complex128))

    def _body_slopes(self, batch: Batch, cols: Columns, solved: Solved) -> NDArray[np.complex128] | float:
        """(H, F, P, V) derivative of the body's echo along every move."""
        if self.body is None or cols.body is None:
            return 0.0
        total: NDArray[np.complex128] | float = 0.0
        at = batch.at
        for i in range(3 if self.body.turns else 2):
            there = at[:, 3:6] + np.eye(3)[i] * _BODY_STEPS[i]
            ahead = self.body.echo(self.spectra, there[:, 0] + 1j * there[:, 1], there[:, 2])
            slope = (ahead - cols.body) / _BODY_STEPS[i] * solved.amplitudes[:, :, 0, None]
            total = total + batch.moves[:, None, :, 3 + i, None] * slope[:, :, None]
        return total

    def _expected(self, batch: Batch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Prior means (H, 6) and precisions (6,) of the coordinates before the angles."""
        mean = np.zeros((len(batch.at), COMMON))
        mean[:, 2] = batch.prior_radius
        weight = np.zeros(COMMON)
        weight[2] = self.priors.radius_m**-2
        weight[:2] = self.priors.centre_m**-2
        if self.body_at is not None and self.body is not None:
            mean[:, 3:6] = self.body_at
            mean[:, 0:2] = self.body_at[:2]
            weight[:2] = max(self.body.slack_m, 1e-4) ** -2
            weight[3:5] = self.priors.centre_m**-2
            weight[5] = 1.0
        return mean, weight

    def _cost(self, batch: Batch, at: NDArray[np.float64], left: NDArray[np.float64]) -> NDArray[np.float64]:
        mean, weight = self._expected(batch)
        return np.asarray(2 * left / self.variance + ((at[:, :COMMON] - mean) ** 2 @ weight))

    def _step(
        self,
        batch: Batch,
        at: NDArray[np.float64],
        normal: NDArray[np.float64],
        gradient: NDArray[np.float64],
        damping: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """(H, P) damped Gauss-Newton steps along the moves."""
        mean, weight = self._expected(batch)
        common = batch.moves[:, :, :COMMON]
        scale = 2 / self.variance
        weighted = common * weight
        hessian = scale * normal + weighted @ np.swapaxes(common, -1, -2)
        gradient = scale * gradient + (weighted @ (at[:, :COMMON] - mean)[..., None])[..., 0]
        size = np.diagonal(hessian, axis1=1, axis2=2)
        load = damping[:, None] * size + np.where(size > 0, 1e-12 * size, 1.0)
        hessian = hessian + load[..., None] * np.eye(hessian.shape[1])
        return -np.asarray(np.linalg.solve(hessian, gradient[..., None])[..., 0])


def _chebyshev(cosine: NDArray[np.float64], terms: int) -> NDArray[np.float64]:
    """(H, 2, M, K, V): cos(p psi) of cos(psi) (H, K, V), p < M, and their derivatives with it."""
    h, k, v = cosine.shape
    out = np.empty((h, 2, terms, k, v))
    value, rise = out[:, 0], out[:, 1]
    value[:, 0], rise[:, 0] = 1.0, 0.0
    if terms > 1:
        value[:, 1], rise[:, 1] = cosine, 1.0
    for p in range(2, terms):
        value[:, p] = 2 * cosine * value[:, p - 1] - value[:, p - 2]
        rise[:, p] = 2 * value[:, p - 1] + 2 * cosine * rise[:, p - 1] - rise[:, p - 2]
    return out
