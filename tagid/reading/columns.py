"""Columns of a body, of reflectors and of odd scatterers, and their slopes over places and turns.

A hypothesis is a product of small choices: a body or none, a transfer, an arrangement of reflectors or none,
and odd scatterers. Its parameters are, in this order: the centre x, y; of an oval body the cosine and sine
part of its support function, m; a turn for every group of reflectors that turns by itself; a stretch (m
outward) for every group that moves outward by itself; a lift (m upward) for every group that rises by itself,
where heights show; x, y of every odd scatterer, and where the antenna stood at several heights its height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from tagid.reading.arrangement import MOUNTING_SD_M, Arrangement
from tagid.reading.bounce import BOUNCE, bounced
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.transfer import ANGLES, Transfer
from tagid.types import Complex, Floats

CENTRE_SD_M = 6e-3
"""Standard deviation of the object's centre about the axis, m."""
PLANE_SD_M, OWN_SD_M = 50e-3, 65e-3
"""Standard deviation of the height of the object's plane over the stated one, and of a free point's, m."""
CLOSEST_M, CLOSE_SD_M = 18e-3, 0.5e-3
"""Nothing else stands in a reflector's place: nearer than this costs, by this standard deviation, m."""
APART_M = 28e-3
"""Two reflectors do not stand nearer: octahedra of 20 mm radius that touch with their edges."""
SHAPE_M = 1e-3
"""Scale of the support function's two-fold part, m: most bodies are round, some are far from it."""
REACH_M = 0.13
"""An odd scatterer stands within this of the axis, m."""
RING_M = (0.02, 0.14)
"""A free ring has a radius between these, m."""
UNLIKE = 0.2
"""Reflectors of one tag differ in strength by this standard deviation, over their mean."""
STRONGEST = 0.5
"""Power of a reflector of two or more, at most, over the moving energy: unlike ones differ from that."""
TABLE_FROM_M, TABLE_STEP_M = 0.016, 0.003
"""Patterns are known for rings of this radius on, in steps of so much: they change slowly with it."""
SECTORS = 36
"""Sectors, starts times widths, of which one may be hidden."""
_CROWDED_M = 1e-5
"""Finite differences of what crowds, m or rad."""
ODD_POWER, FACE_POWER = 0.1, 1.0
"""Prior powers of an odd scatterer and of a face, which is loud where it is seen, over the moving energy."""
FACES = 0.25
"""Share of the odd scatterers that are faces of a width."""

Face = tuple[float, float]
"""Direction from which a face is seen best, and standard deviation of those from which it is seen, rad."""
PAST: Face = (0.0, float("inf"))
"""An odd scatterer that is seen from all sides and past the body; others stand in the field of a sheet."""


def seen_of(toward: Floats | float, width: Floats | float, direction: Floats) -> Floats:
    """How much of faces is seen from directions, see `Face`, rad."""
    return np.asarray(np.exp(-0.5 * (np.angle(np.exp(1j * (direction - toward))) / width) ** 2))


def nearest_ring(radius_m: float) -> float:
    """Radius of the ring whose patterns serve for this one, m."""
    return round(round(max(float(radius_m), TABLE_FROM_M) / TABLE_STEP_M) * TABLE_STEP_M, 4)


@lru_cache(maxsize=1024)
def table_of(transfer: Transfer, kappa: bytes, radius_m: float) -> Complex:
    """(P, F, ANGLES) patterns of a transfer on a ring, see `Transfer.table`."""
    return np.ascontiguousarray(transfer.table(np.frombuffer(kappa), radius_m))


def patterns(
    spectra: Spectra, transfer: Transfer, radius_m: Floats, facing: Floats, slope: bool = False
) -> tuple[Complex, Complex | None]:
    """(K, P, F, V) patterns of reflectors that face so, rad, as seen from the antennas, and their slopes.

    The slope is over the angle psi between outward direction and antenna.
    """
    psi = spectra.direction - facing[:, None]
    at = psi * (ANGLES / (2 * np.pi))
    low = np.floor(at)
    part = at - low
    index = low.astype(np.intp) % ANGLES
    here, slopes = [], []
    for k, radius in enumerate(radius_m):
        table = table_of(transfer, spectra.kappa.tobytes(), nearest_ring(radius))
        first = table[:, :, index[k]]
        rise = table[:, :, (index[k] + 1) % ANGLES] - first
        here.append(first + rise * part[k])
        if slope:
            slopes.append(rise * (ANGLES / (2 * np.pi)))
    return np.stack(here), np.stack(slopes) if slope else None


class Seen(Protocol):
    """Columns of a model at some parameters."""

    @property
    def values(self) -> Complex:
        """(F, n, V)."""

    def slopes(self, weights: Complex) -> Complex:
        """(P, F, V) change of the sum of weights (F, n, 1 or V) times columns with the parameters."""


@dataclass(frozen=True)
class Priors:
    """What is known of an object before it is seen.

    Attributes:
        centre_m: standard deviation of its centre about the axis, per coordinate, m.
        mounting_m: standard deviation of a reflector's distance from the centre as enrolled, m.
        reach_m: odd scatterers stand within this of the axis, m.
    """

    centre_m: float = CENTRE_SD_M
    mounting_m: float = MOUNTING_SD_M
    reach_m: float = REACH_M


@dataclass(frozen=True, eq=False)
class Model:
    """A hypothesis of points: what the columns are functions of.

    Attributes:
        transfer: of the reflectors; also says whether there is a body.
        tag: the reflectors, or None.
        oval: the body may be oval: its echo comes from a distance of p cos 2 phi + q sin 2 phi before its
            centre, and its strength may have two-fold tangents. A smooth convex body returns the echo of its
            specular point, which lies at its support function (J. B. Keller, *IRE Trans. Antennas Propag.* 4,
            1956).
        disc: number of the clutter's disc, see `CLUTTER_RADII_M`.
        odd: number of odd scatterers.
        hidden: start and width, rad, of a sector of directions that sees no reflector; width 0: none.
        levels: heights at which the antenna stood. From one, a lift of all changes no echo but for its phase,
            which the amplitudes have free: then there is none unless the heights of the tag differ.
        priors: of centre and mounting.
        faces: of the odd scatterers that are seen from a side alone: a flat wall, a handle.
    """

    transfer: Transfer
    tag: Arrangement | None
    oval: bool
    disc: int
    odd: int = 0
    hidden: tuple[float, float] = (0.0, 0.0)
    levels: int = 1
    priors: Priors = Priors()
    faces: tuple[Face | None, ...] = ()

    @property
    def body_parameters(self) -> int:
        """Parameters of a body with a centre of its own: they come first; the tag's centre is about that."""
        return 0

    @property
    def head(self) -> int:
        """Parameters before those of the reflectors."""
        return self.body_parameters + 2 + self.shapes

    @property
    def shapes(self) -> int:
        """Parameters of the body's shape."""
        return 2 if self.oval and self.transfer.body else 0

    @property
    def about(self) -> slice:
        """Parameters of the tag's centre."""
        return slice(self.body_parameters, self.body_parameters + 2)

    @property
    def place_rows(self) -> list[int]:
        """Parameters that are the x of a place about the axis, before its y."""
        end = self.parameters
        return [0, *range(end - self.spot * self.odd, end, self.spot)]

    @property
    def parameters(self) -> int:
        tag = 0 if self.tag is None else self.tag.turns + self.tag.stretches
        return self.head + tag + self.lifts + self.spot * self.odd

    @property
    def lifts(self) -> int:
        """Parameters of the reflectors' heights."""
        return self.tag.lifts if self.tag is not None and (self.levels > 1 or self.tag.tall) else 0

    @property
    def spot(self) -> int:
        """Parameters of an odd scatterer."""
        return 3 if self.levels > 1 else 2

    @property
    def columns(self) -> int:
        return (
            self.body_columns
            + (0 if self.tag is None else len(self.transfer.power) + self.bounces + self.unlike)
            + self.odd
        )

    @property
    def body_columns(self) -> int:
        """Number of columns of the body."""
        return (3 if self.oval else 1) if self.transfer.body else 0

    @property
    def bounces(self) -> int:
        """Number of columns for what passes from one reflector to another."""
        return 1 if self.tag is not None and self.tag.count > 1 and self.transfer.open else 0

    @property
    def unlike(self) -> int:
        """Number of columns for the unlike strength of the reflectors."""
        return 0 if self.tag is None or self.tag.count < 2 else self.tag.count

    @property
    def covers_middle(self) -> bool:
        """A reflector in the middle looks like the body."""
        return self.transfer.body and not self.transfer.clear

    @property
    def tagged(self) -> bool:
        """It has reflectors."""
        return self.tag is not None

    @property
    def whole(self) -> bool:
        """Its echo is that of an object with its tag: reflectors beside it are less or more of that."""
        return False

    @property
    def identity(self) -> str | None:
        """What an enrolled object stands for by itself."""
        return None

    def error(self, spectra: Spectra) -> Floats | float:
        """(F, M) variance of what differs from an enrolled echo."""
        return 0.0

    @property
    def words(self) -> str:
        """The body in words, if there is one."""
        return self.transfer.words

    def seeing(self, direction: Floats) -> NDArray[np.bool_]:
        """(V,) whether the reflectors are seen from directions (V,), rad."""
        return np.mod(direction - self.hidden[0], 2 * np.pi) >= self.hidden[1]

    def and_odd(self, face: Face | None = None) -> Self:
        """The same beside one odd scatterer more."""
        return replace(self, odd=self.odd + 1, faces=(*self._faces, face))

    @property
    def _faces(self) -> tuple[Face | None, ...]:
        """One for each odd scatterer."""
        return (self.faces + (None,) * self.odd)[: self.odd]

    def windows(self, direction: Floats) -> Floats:
        """(odd, V) how much of every odd scatterer is seen from directions (V,), rad."""
        toward, width = np.array([face or PAST for face in self._faces]).reshape(-1, 2).T[:, :, None]
        return seen_of(toward, width, direction)

    @property
    def faced(self) -> tuple[bool, ...]:
        """Which of the odd scatterers are faces."""
        return tuple(face not in (None, PAST) for face in self._faces)

    def split(self, x: Floats) -> tuple[complex, Floats, Floats, Complex]:
        """Centre, turns, stretches and odd places of parameters."""
        turn, stretch, _ = self._cuts
        return complex(self._centre(x)), x[turn], x[stretch], self._spots(x)

    def _centre(self, x: Floats) -> Complex:
        a = self.body_parameters
        offset = x[..., a] + 1j * x[..., a + 1]
        return np.asarray(offset + (x[..., 0] + 1j * x[..., 1]) if a else offset)

    def _spots(self, x: Floats) -> Complex:
        odd = x[..., self._cuts[2]]
        return np.asarray(odd[..., :: self.spot] + 1j * odd[..., 1 :: self.spot])

    @cached_property
    def _cuts(self) -> tuple[slice, slice, slice]:
        """Parameters of the turns, the stretches and the odd scatterers."""
        t = self.head + (0 if self.tag is None else self.tag.turns)
        s = t + (0 if self.tag is None else self.tag.stretches)
        return slice(self.head, t), slice(t, s), slice(s + self.lifts, None)

    def heights_of(self, x: Floats) -> tuple[Floats, Floats]:
        """(K,) of the reflectors and (m,) of the odd scatterers, m."""
        up = x[len(x) - 3 * self.odd :][2::3] if self.levels > 1 else np.zeros(self.odd)
        if self.tag is None:
            return np.zeros(0), up
        first = self.head + self.tag.turns + self.tag.stretches
        return self.tag.height_m + (x[first:][self.tag.lift] if self.lifts else 0.0), up

    def at(self, spectra: Spectra, x: Floats, slopes: bool = True) -> Seen:
        """The columns at parameters x (P,); slopes: those are wanted, too."""
        return Columns.of(self, spectra, x, slopes)

    def positions(self, x: Floats) -> Complex:
        """(.., K) of the reflectors, x + jy, m, at parameters (.., P)."""
        if self.tag is None:
            return np.zeros((*x.shape[:-1], 0), dtype=complex)
        turn, stretch = self._moved
        out = (self.tag.radius_m + x[..., stretch]) * np.exp(1j * (self.tag.angle + x[..., turn]))
        return np.asarray(self._centre(x)[..., None] + out)

    @cached_property
    def _moved(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """(K,) parameters that turn every reflector and move it outward."""
        assert self.tag is not None
        return self.tag.turn + self._cuts[0].start, self.tag.stretch + self._cuts[1].start

    def power(self, moving: Floats, body: float, tag: float, oval: float) -> Floats:
        """(F, n) prior variances of the amplitudes."""
        parts: list[float] = []
        if self.transfer.body:
            parts += [body, body * oval, body * oval] if self.oval else [body]
        if self.tag is not None:
            parts += [tag * p for p in self.transfer.power]
            parts += [tag * BOUNCE**2] * self.bounces
            parts += [min(tag, STRONGEST) * self.transfer.power[0] * UNLIKE**2] * self.unlike
        parts += [FACE_POWER if faced else ODD_POWER for faced in self.faced]
        return np.asarray(moving[:, None] * np.array(parts))

    @cached_property
    def precision(self) -> Floats:
        """(P,) inverse variances of the prior; those of flat ones serve the Laplace term alone."""
        return np.asarray(self._sds() ** -2.0)

    def _sds(self) -> Floats:
        sds = [self.priors.centre_m] * 2 + [3 * SHAPE_M] * self.shapes
        if self.tag is not None:
            sds += [2 * np.pi / np.sqrt(12)] * self.tag.turns
            mounting = float(np.hypot(self.priors.mounting_m, self.transfer.radius_sd_m))
            sds += [np.ptp(RING_M) / np.sqrt(12) if free else mounting for free in self.tag.free]
            common = np.bincount(self.tag.lift) > 1
            sds += [PLANE_SD_M if several else OWN_SD_M for several in common[: self.lifts]]
        spot = [self.priors.reach_m / 2, self.priors.reach_m / 2, OWN_SD_M][: self.spot]
        return np.array(sds + spot * self.odd)

    @cached_property
    def _normal(self) -> NDArray[np.bool_]:
        """(P,) which parameters have a Gaussian prior."""
        flags = [True, True] + [False] * self.shapes
        if self.tag is not None:
            certain = [not (free or self.tag.glued) for free in self.tag.free]
            flags += [False] * self.tag.turns + certain + [not self.tag.glued] * self.lifts
        return np.array(flags + [False, False, True][: self.spot] * self.odd)

    def log_prior(self, x: Floats, *, slopes: bool = False) -> tuple[float, Floats, Floats]:
        """Log density less what crowds, its slope (P,) and precision (P, P) of what pulls the parameters."""
        log, slope, hessian = self._log_prior(x)
        crowding = self.crowding(x)
        if slopes and crowding.any():
            step = _CROWDED_M * np.eye(len(x))
            rise = (self.crowding(x + step) - self.crowding(x - step)) / (2 * _CROWDED_M)
            slope, hessian = slope - rise @ crowding, hessian + rise @ rise.T
        return log - 0.5 * float(crowding @ crowding), slope, hessian

    def _log_prior(self, x: Floats) -> tuple[float, Floats, Floats]:
        slope, hessian = -self.pull @ x, self.pull.copy()
        log = self.log_at_mean + 0.5 * float(slope @ x)
        if self.shapes:
            # Cauchy's distribution in two dimensions.
            size = SHAPE_M**2 + float(x[2:4] @ x[2:4])
            log += float(np.log(SHAPE_M / (2 * np.pi)) - 1.5 * np.log(size))
            slope[2:4] -= 3 * x[2:4] / size
            hessian[[2, 3], [2, 3]] += 3 / size
        return log, slope, hessian

    @cached_property
    def _glue(self) -> tuple[float, Floats]:
        assert self.tag is not None
        outward = float(np.hypot(self.priors.mounting_m, self.transfer.radius_sd_m))
        return self.tag.glue(outward, *[PLANE_SD_M] * bool(self.lifts))

    @cached_property
    def pull(self) -> Floats:
        """(P, P) precision of the Gaussian priors."""
        pull = np.diag(np.where(self._normal, self.precision, 0.0))
        if self.tag is not None and self.tag.glued:
            tagged = slice(self.head, self.head + len(self._glue[1]))
            pull[tagged, tagged] = self._glue[1]
        return pull

    @cached_property
    def log_at_mean(self) -> float:
        """The largest log density of the prior."""
        log = 0.5 * float(np.log(self.precision[self._normal] / (2 * np.pi)).sum())
        if self.tag is not None and self.tag.glued:
            log += self._glue[0]
        elif self.tag is not None:
            log -= self.tag.turns * np.log(2 * np.pi)
            log -= self.tag.free.sum() * np.log(np.ptp(RING_M)) - _log_factorial(self.tag.turns)
        log -= self.odd * np.log(np.pi * self.priors.reach_m**2) - _log_factorial(self.odd)
        log += float(np.log(FACES)) * sum(self.faced)
        return float(log - (np.log(SECTORS) if self.hidden[1] else 0.0))

    def crowding(self, x: Floats) -> Floats:
        """(.., N) standard deviations by which points are too close or far, or rings, shapes of no tag."""
        first, second, rise, least = pairs(self.tag, self.odd)
        # Nothing odd stands farther out: a scatterer that is worth nothing would be free to leave.
        parts = [np.abs(self._spots(x)) - self.priors.reach_m]
        if len(first):
            positions = np.concatenate([self.positions(x), self._spots(x)], axis=-1)
            apart = positions[..., first] - positions[..., second]
            parts.append(least - np.sqrt(apart.real**2 + apart.imag**2 + rise))
        if self.tag is not None and self.tag.free.any():
            free = self.tag.free[self.tag.stretch]
            radius = self.tag.radius_m[free] + x[..., self._moved[1][free]]
            parts.append(np.maximum(RING_M[0] - radius, radius - RING_M[1]))
        if self.shapes:
            # A convex body inside the tag's ring has a radius of curvature everywhere.
            inside = REACH_M if self.tag is None else float(self.tag.radius_m.max())
            parts.append(3 * np.hypot(x[..., 2:3], x[..., 3:4]) - inside)
        return np.asarray(np.maximum(np.concatenate(parts, axis=-1), 0) / CLOSE_SD_M)


@lru_cache(maxsize=256)
def pairs(tag: Arrangement | None, odd: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats]:
    """Pairs of reflectors and odd scatterers, squared differences in height, m^2, least distances, m."""
    height = np.append(np.zeros(0) if tag is None else tag.height_m, np.zeros(odd))
    first, second = np.triu_indices(len(height), 1)
    # Only heights of one group are known: nothing stands above or below a reflector, its own row apart.
    group = np.append([] if tag is None else tag.lift, -1 - np.arange(odd))
    rise = np.where(group[first] == group[second], (height[first] - height[second]) ** 2, 0.0)
    least = np.where(second < len(height) - odd, APART_M, CLOSEST_M)
    if tag is not None and tag.count > 1:
        # An enrolled tag stands as it was built.
        positions = tag.radius_m * np.exp(1j * tag.angle)
        alike = second < len(positions)
        built = np.hypot(np.abs(positions[first[alike]] - positions[second[alike]]), np.sqrt(rise[alike]))
        least[alike] = APART_M if tag.turns > 1 and not tag.glued else np.minimum(built, APART_M)
    return first, second, rise, least


def _log_factorial(n: int) -> float:
    return float(np.log(np.arange(1, n + 1)).sum())


def _twice(angle: Floats) -> Floats:
    """(2, K) cosine and sine of twice the angles (K,)."""
    return np.stack([np.cos(2 * angle), np.sin(2 * angle)])


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of a model at some parameters, with what their slopes need.

    Attributes:
        values: (F, n, V).
        tilt: (2,) angle of the wall's normal to the direction from the centre, cosine and sine of two cycles
            round the body, rad; None: none, and no slopes over it, which come last.
    """

    model: Model
    spectra: Spectra
    x: Floats
    values: Complex
    waves: Complex
    toward: Complex
    up: Floats
    range_m: Floats
    pattern: Complex | None
    turned: Complex | None
    oval: Floats | None
    bounce: Complex | None
    tilt: Floats | None = None

    @classmethod
    def of(
        cls, model: Model, spectra: Spectra, x: Floats, slopes: bool = True, *, tilt: Floats | None = None
    ) -> Columns:
        """Those of a model at parameters x (P,)."""
        centre, turn, _, odd = model.split(x)
        tag = model.tag
        body = 1 if model.transfer.body else 0
        positions = np.concatenate([[centre] * body, model.positions(x), odd])
        heights = np.zeros(len(positions))
        k = 0 if tag is None else tag.count
        heights[body : body + k], heights[body + k :] = model.heights_of(x)
        waves, range_m = spectra.waves(positions, heights)
        waves[:, body + k :] *= model.windows(spectra.direction)
        toward = (positions[:, None] - spectra.antenna) / range_m
        up = (heights[:, None] - spectra.height_m) / range_m
        parts, pattern, turned, oval, bounce = [], None, None, None, None
        if model.shapes:
            near = x[2] * np.cos(2 * spectra.direction) + x[3] * np.sin(2 * spectra.direction)
            waves[:, 0] *= np.exp(1j * spectra.kappa[:, None] * near)
        if body:
            parts.append(waves[:, :1])
            if model.oval:
                oval = _twice(spectra.direction)
                parts.append(waves[:, :1] * oval)
        if tag is not None:
            facing = tag.angle + turn[tag.turn]
            if tilt is not None:
                facing = facing + tilt @ _twice(facing)
            pattern, turned = patterns(spectra, model.transfer, tag.radius_m, facing, slopes)
            if model.hidden[1]:
                seen = model.seeing(spectra.direction)
                pattern = pattern * seen
                turned = turned if turned is None else turned * seen
            parts.append(np.einsum("kpfv,fkv->fpv", pattern, waves[:, body : body + k]))
            if model.bounces:
                tagged = slice(body, body + k)
                there = positions[tagged], heights[tagged], range_m[tagged], toward[tagged], up[tagged]
                value, bounce = bounced(spectra, *there, model.seeing(spectra.direction))
                parts.append(value[:, None])
            if model.unlike:
                parts.append(np.moveaxis(pattern[:, 0], 0, 1) * waves[:, body : body + k])
        parts.append(waves[:, body + k :])
        values = np.concatenate(parts, axis=1)
        return cls(model, spectra, x, values, waves, toward, up, range_m, pattern, turned, oval, bounce, tilt)

    def _weighted(self, weights: Complex) -> tuple[Complex, Complex | None]:
        """(F, S, V) every source's patterns summed with weights (F, n, V or 1), and those of the slopes."""
        model = self.model
        body = model.body_columns
        out = np.empty_like(self.waves)
        first = 0
        if body:
            out[:, 0] = weights[:, 0]
            if self.oval is not None:
                out[:, 0] = weights[:, 0] + (weights[:, 1:3] * self.oval).sum(axis=1)
            first = 1
        turned = None
        k = 0
        if self.pattern is not None and model.tag is not None:
            k = model.tag.count
            p = len(model.transfer.power)
            w = np.broadcast_to(weights[:, body : body + p], (len(out), p, out.shape[2]))
            out[:, first : first + k] = np.einsum("kpfv,fpv->fkv", self.pattern, w)
            body += p
            if self.turned is not None:
                turned = np.einsum("kpfv,fpv->fkv", self.turned, w)
            body += model.bounces
            if model.unlike:
                weight = weights[:, body : body + k]
                out[:, first : first + k] += np.moveaxis(self.pattern[:, 0], 0, 1) * weight
                if turned is not None and self.turned is not None:
                    turned += np.moveaxis(self.turned[:, 0], 0, 1) * weight
                body += k
        out[:, first + k :] = weights[:, body:]
        return out, turned

    def slopes(self, weights: Complex) -> Complex:
        """See `Seen`; weights: (F, n, 1) amplitudes, or (F, n, V) any."""
        model, x = self.model, self.x
        sources, turned = self._weighted(weights)
        moved = sources * self.waves * (-1j * self.spectra.kappa[:, None, None] - 2 / self.range_m)
        along_x, along_y, upward = moved * self.toward.real, moved * self.toward.imag, moved * self.up
        first = 1 if model.transfer.body else 0
        k = 0 if model.tag is None else model.tag.count
        if self.bounce is not None:
            column = model.body_columns + len(model.transfer.power)
            for along, more in zip((along_x, along_y, upward), self.bounce, strict=True):
                along[:, first : first + k] += more * weights[:, None, column]
        tilts = 0 if self.tilt is None else len(self.tilt)
        out = np.zeros((model.parameters + tilts, *self.spectra.data.shape), dtype=np.complex128)
        out[0] = along_x[:, : first + k].sum(axis=1)
        out[1] = along_y[:, : first + k].sum(axis=1)
        if model.shapes and self.oval is not None:
            nearer = 1j * self.spectra.kappa[:, None] * sources[:, 0] * self.waves[:, 0]
            out[2:4] = nearer * self.oval[:, None]
        row = 2 + model.shapes
        if model.tag is not None and turned is not None:
            centre, turn, _, _ = model.split(x)
            direction = model.tag.angle + turn[model.tag.turn]
            outward = np.exp(1j * direction)
            across = 1j * (model.positions(x) - centre)
            tagged = slice(first, first + k)
            faced = np.asarray(-turned * self.waves[:, tagged])
            spun = faced.copy()
            if self.tilt is not None:
                cosine, sine = twice = _twice(direction)
                out[-2:] = np.einsum("fkv,ck->cfv", faced, twice)
                # A turn about the centre moves the reflector along a wall whose normal changes.
                spun += faced * (2 * (self.tilt[1] * cosine - self.tilt[0] * sine))[:, None]
            spun += along_x[:, tagged] * across.real[:, None] + along_y[:, tagged] * across.imag[:, None]
            drawn = along_x[:, tagged] * outward.real[:, None] + along_y[:, tagged] * outward.imag[:, None]
            for i in range(k):
                out[row + model.tag.turn[i]] += spun[:, i]
                out[row + model.tag.turns + model.tag.stretch[i]] += drawn[:, i]
            row += model.tag.turns + model.tag.stretches
            for i in range(k if model.lifts else 0):
                out[row + model.tag.lift[i]] += upward[:, first + i]
            row += model.lifts
        for i in range(first + k, first + k + model.odd):
            out[row : row + 2] = along_x[:, i], along_y[:, i]
            if model.spot > 2:
                out[row + 2] = upward[:, i]
            row += model.spot
        return out
