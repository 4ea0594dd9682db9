"""Thin shells as bodies: their echo, and the one that explains some scans best.

A helmet is a sheet of plastic, about elliptic at the height of its reflectors. Two half axes and the strength
of the sheet fix its echo from all sides, but for one amplitude per frequency (`tagid.fields.thin_shell`); so
do two sides that of a carton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField, ShellView, ThinShell
from tagid.tags.bodies.enrolled import SLACK_M, EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Candidate, Pose, Seen
from tagid.tags.bodies.posing import CENTRE_SIGMA_M, PoseSearch, search_step
from tagid.tags.bodies.signature import Signature, near_field, order_of
from tagid.tags.bodies.spectra import Spectra, centred

SHEET_M = 2.8e-3
"""(eps - 1) d of a helmet's shell, halved because it ends above and below: 2.4 to 2.9 mm fit solved shells of
2.4 to 3.5 mm plastic with permittivities of 2.5 to 3.1."""
ACROSS = (0.58, 0.61, 0.64, 0.67, 0.70, 0.73, 0.76)
ALONG = (0.74, 0.77, 0.80, 0.83, 0.86, 0.89, 0.92)
"""Half axes that are tried over the radius of the reflectors' ring. Those between them are 1.7 mm away."""
BOX_SHEET_M = 2.8e-3
"""(eps - 1) d of a carton's or a crate's walls: 2.5 to 4 mm fit solved ones."""
_STEP = 1.05
HALF_SIDES_M = tuple(0.025 * _STEP**i for i in range(29))
"""Half sides of boxes that are tried, 25 to 98 mm."""
_NEAR = 2
"""Best boxes beside which those with a side one step off are tried."""
_SIDES = 5
"""Half sides of the best square boxes, whose pairs are tried as oblong ones."""
UNLIKE = 0.06
"""Boxes whose sides differ by less are one: the fit moves so far."""
OBLONG = 1.04
"""Least ratio of the half axes: a round shell is a round body."""
SEARCHED, _REFINED = 72, 84
"""Points of the contour in the search, and in the fit."""
_STEPS = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-4])
"""Finite differences of centre, m, turn, rad, and half axes, m."""


@dataclass(frozen=True)
class ShellFit:
    """A shell that explains some scans.

    Attributes:
        shell: its shape.
        pose: its centre and turn.
        left: energy that it leaves, alone or beside the reflectors that were fitted with it.
    """

    shell: ThinShell
    pose: Pose
    left: float


@dataclass(frozen=True, eq=False)
class ShellBody:
    """A thin shell that nobody enrolled (a `BodyModel`).

    Attributes:
        fit: its shape, and where it was found.
        wavenumbers: (F,) kappa at which its harmonics are known, rad/m.
        distance_m: at which they are.
    """

    fit: ShellFit
    wavenumbers: NDArray[np.float64]
    distance_m: float

    @property
    def name(self) -> str:
        """None."""
        return ""

    @property
    def turns(self) -> bool:
        """Its echo depends on its turn."""
        return True

    @property
    def turning_share(self) -> float:
        """Energy of what depends on it over that of the whole echo."""
        return self._known.turning_share

    @property
    def slack_m(self) -> float:
        """Standard deviation of a tag's centre about the body's, m."""
        return SLACK_M

    def poses(self, spectra: Spectra) -> list[Candidate]:
        """Where it was found."""
        return [Candidate(self.fit.pose, self.fit.left)]

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """(H, F, V) its echo at centres x + jy (H,), m, and turns (H,), rad."""
        return self._known.echo(spectra, centres, turns)

    def seen(
        self,
        spectra: Spectra,
        pose: Pose,
        beside: NDArray[np.complex128] | None = None,
        variance: float = 0.0,
    ) -> Seen | None:
        """None: it is fitted to the scans as they are."""
        return None

    @cached_property
    def _known(self) -> EnrolledBody:
        return EnrolledBody(signature_of(self.fit.shell, self.wavenumbers, self.distance_m), Searches(1))


def signature_of(shell: ThinShell, wavenumbers: NDArray[np.float64], distance_m: float) -> Signature:
    """The echo of a shell as angular harmonics, as those of an enrolled body.

    Args:
        shell: about its own centre.
        wavenumbers: (F,) kappa, rad/m.
        distance_m: of the antenna, m.
    """
    radius = shell.radius_m
    order = order_of(float(wavenumbers[-1]), radius)
    aspects = 2 * order + 4
    antenna = distance_m * np.exp(2j * np.pi * np.arange(aspects) / aspects)
    seen = ShellField.of(wavenumbers / 2, shell, SEARCHED).echo(antenna)
    seen = seen * np.exp(1j * wavenumbers[:, None] * distance_m)
    m = np.arange(-order, order + 1)
    harmonics = np.fft.fft(seen, axis=1)[:, m % aspects] / aspects
    harmonics = harmonics / near_field(wavenumbers, order, distance_m)
    # One amplitude per frequency is free: those of this one are alike.
    harmonics = harmonics / np.linalg.norm(harmonics, axis=1, keepdims=True)
    noise = np.full(len(wavenumbers), 1e-9)
    return Signature("shell", "body", wavenumbers, harmonics, noise, radius, distance_m)


@lru_cache(maxsize=4)
def _dictionary(
    wavenumbers: bytes, distance_m: float, ring_m: float
) -> tuple[tuple[ThinShell, Signature], ...]:
    """Shells inside a ring with their harmonics."""
    kappa = np.frombuffer(wavenumbers)
    sizes = [(a * ring_m, b * ring_m) for a in ACROSS for b in ALONG if b >= OBLONG * a]
    shells = [EllipticShell(across, along, SHEET_M) for across, along in sizes]
    return tuple((one, signature_of(one, kappa, distance_m)) for one in shells)


def likely_shells(spectra: Spectra, ring_m: float, count: int) -> list[ShellFit]:
    """The shells inside a ring of reflectors that explain scans best, over all sizes, turns and centres.

    Args:
        spectra: the scans.
        ring_m: radius of the ring, m.
        count: number of them.
    """
    spectra = spectra.thinned(search_step(spectra))
    known = _dictionary(spectra.wavenumbers.tobytes(), round(spectra.distance_m, 2), ring_m)
    search = PoseSearch(spectra, max(signature.order for _, signature in known))
    found = []
    for shape, signature in known:
        left, pose = search.best(signature, shape.alike)
        found.append(ShellFit(shape, pose, left))
    return sorted(found, key=lambda fit: fit.left)[:count]


def likely_boxes(spectra: Spectra, count: int) -> list[ShellFit]:
    """The boxes that explain scans best and differ in size, over all sizes, turns and centres.

    A square box whose side is one of two of an oblong one explains the flashes of two of its walls.

    Args:
        spectra: the scans.
        count: number of them.
    """
    spectra = spectra.thinned(search_step(spectra))
    wavenumbers, distance = spectra.wavenumbers.tobytes(), round(spectra.distance_m, 2)
    widest = np.sqrt(2) * _STEP * HALF_SIDES_M[-1]
    search = PoseSearch(spectra, order_of(float(spectra.wavenumbers[-1]), widest))

    def fitted(across_m: float, along_m: float) -> ShellFit:
        shell = BoxShell(across_m, along_m, BOX_SHEET_M)
        signature = _box_signature(wavenumbers, distance, across_m, along_m)
        left, pose = search.best(signature, shell.alike)
        return ShellFit(shell, pose, left)

    fits = [fitted(half, half) for half in HALF_SIDES_M]
    sides = sorted(fit.shell.across_m for fit in _unlike(fits, _SIDES))
    fits += [fitted(a, b) for i, a in enumerate(sides) for b in sides[i + 1 :]]
    # The best side of a square is that of the nearest oblong box to within some steps.
    for near in _unlike(fits, _NEAR):
        a, b = near.shell.across_m, near.shell.along_m
        fits += [fitted(a * x, b * y) for x, y in ((_STEP, 1), (1 / _STEP, 1), (1, _STEP), (1, 1 / _STEP))]
    return _unlike(fits, count)


def _unlike(fits: Sequence[ShellFit], count: int) -> list[ShellFit]:
    """The best shells, none of about the size of a better one."""
    found: list[ShellFit] = []
    for fit in sorted(fits, key=lambda one: one.left):
        sizes = np.array([fit.shell.across_m, fit.shell.along_m])
        if all((np.abs(sizes / (one.shell.across_m, one.shell.along_m) - 1) > UNLIKE).any() for one in found):
            found.append(fit)
    return found[:count]


@lru_cache(maxsize=1024)
def _box_signature(wavenumbers: bytes, distance_m: float, across_m: float, along_m: float) -> Signature:
    shell = BoxShell(across_m, along_m, BOX_SHEET_M)
    return signature_of(shell, np.frombuffer(wavenumbers), distance_m)


def basis_of(
    view: ShellView, obliquities: int, tag: NDArray[np.complex128] | None = None
) -> NDArray[np.complex128]:
    """(F, V, C) orthonormal echoes that a shell may have, without the room, beside a tag's (F, V).

    Args:
        view: of the shell.
        obliquities: amplitudes per frequency, see `ShellView.echoes`.
        tag: echo of reflectors; None for none.
    """
    waves = view.echoes(obliquities)
    if tag is not None:
        waves = np.concatenate([waves, tag[:, None]], axis=1)
    waves = centred(waves)
    waves = waves / np.maximum(np.linalg.norm(waves, axis=2, keepdims=True), 1e-30)
    return np.asarray(np.linalg.qr(np.swapaxes(waves, 1, 2))[0])


def beyond(waves: NDArray[np.complex128], basis: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Waves (F, ..., V) without what a basis (F, V, C) holds of them."""
    shape = waves.shape
    flat = waves.reshape(shape[0], -1, shape[-1])
    return np.asarray(flat - (flat @ basis.conj()) @ np.swapaxes(basis, 1, 2)).reshape(shape)


def refined_beside(
    spectra: Spectra, start: ShellFit, tag: NDArray[np.complex128], obliquities: int, rounds: int = 4
) -> ShellFit:
    """The shell near a start that explains most beside reflectors: centre, turn and half axes.

    Levenberg-Marquardt with the amplitudes of shell and reflectors eliminated (variable projection).

    Args:
        spectra: the scans.
        start: where it begins.
        tag: (F, V) echo of the reflectors.
        obliquities: amplitudes of the shell per frequency.
        rounds: at most.
    """
    shell, pose = start.shell, start.pose
    data = spectra.data

    def field_at(x: NDArray[np.float64]) -> ShellField:
        shape = replace(shell, across_m=float(x[3]), along_m=float(x[4]))
        return ShellField.of(spectra.wavenumbers / 2, shape, _REFINED)

    def rest(x: NDArray[np.float64], field: ShellField) -> NDArray[np.complex128]:
        antenna = (spectra.antenna - complex(x[0], x[1])) * np.exp(-1j * x[2])
        return beyond(data, basis_of(field.seen_from(antenna), obliquities, tag))

    prior = np.array([CENTRE_SIGMA_M, CENTRE_SIGMA_M, np.inf, np.inf, np.inf]) ** -2.0
    prior *= max(spectra.noise, 0.01 * spectra.energy / spectra.data.size)

    def cost(x: NDArray[np.float64], left: NDArray[np.complex128]) -> float:
        return float((np.abs(left) ** 2).sum() + prior @ x**2)

    x = np.array([*pose.centre_m, pose.turn_rad, shell.across_m, shell.along_m])
    least, most = 0.8 * x[3:], 1.25 * x[3:]
    field = field_at(x)
    left = rest(x, field)
    now, damping = cost(x, left), 1e-2
    for _ in range(rounds):
        moved = [
            rest(x + step, field if i < 3 else field_at(x + step)) for i, step in enumerate(np.diag(_STEPS))
        ]
        slopes = np.stack([(one - left).ravel() / size for one, size in zip(moved, _STEPS, strict=True)])
        normal = np.real(slopes.conj() @ slopes.T) + np.diag(prior)
        gradient = np.real(slopes.conj() @ left.ravel()) + prior * x
        gain = 0.0
        for _ in range(3):
            size = np.diag(normal)
            damped = normal + np.diag(damping * size + 1e-12 * size.sum() + 1e-300)
            trial = x - np.linalg.solve(damped, gradient)
            trial[3:] = np.clip(trial[3:], least, most)
            there = field_at(trial)
            trial_left = rest(trial, there)
            value = cost(trial, trial_left)
            if value < now:
                gain = now - value
                x, field, left, now, damping = trial, there, trial_left, value, damping / 5
                break
            damping *= 8
        if gain < 1e-3 * now:
            break
    pose = Pose((float(x[0]), float(x[1])), float(np.mod(x[2], 2 * np.pi)))
    return ShellFit(field.shell, pose, float((np.abs(left) ** 2).sum()))
