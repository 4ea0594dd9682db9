"""A signature from several captures of one object: poses, gains and harmonics together, and checked.

For given poses and gains the harmonics are a linear least squares over all captures; for given harmonics and
poses so are the gains. The poses follow by Levenberg-Marquardt on the residual of the joint least squares,
which must be noise: a capture of something else, or of the object after a reflector moved, would spoil every
later reading, so it is reported.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.counting import counted
from tagid.errors import DataError
from tagid.tags.bodies.posing import PoseSearch, matches, noise_of, refine, round_centre
from tagid.tags.bodies.signature import (
    Pose,
    Signature,
    SignatureKind,
    Standpoint,
    angular,
    echo,
    near_field,
    order_mask,
    order_of,
)
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.steadying import steadied

CAPTURES = 3
"""Two captures show that they differ, three show which one."""
RADII_M = (0.04, 0.055, 0.07, 0.085, 0.10, 0.12, 0.14)
"""Radii tried for an object of unknown size."""
START_RADII_M = (0.07, 0.12)
RIDGE = 1e-4
"""Load of the normal equations as a share of their mean diagonal."""
ROUND_RIDGE = 1e-3
"""The same for m = 0, relative to RIDGE. The echo of a centred round body is constant over the views, like
the room; only centres that differ distinguish the two, and a load on m = 0 would turn the body into
room."""
ROUND_SHARE = 0.3
"""A body of revolution with a residual under this share of the moving echo gives the object's centre."""
NOISE_SLACK = 0.4
"""What a capture may keep beyond its noise, as a share of it: the noise is known to 10 %, and coloured noise
or interference inside the band is not in the estimate."""
MODEL_SHARE = 0.008
"""What a capture may keep of its turning echo. Full-wave captures of one object keep up to 0.2 % (other
distance and place); one from which a tag 17 dB under the turning echo was taken keeps over 1 %."""
MOVING_SHARE = 0.001
"""And of all that moves: a round body far off the axis is 20 to 35 dB over its noise. The residual
of a cup was 0.04 %, as that of an uneven turn would be; a tag that is worth a name returns more."""
UNEVEN_SHARE = 0.001
"""Where a capture keeps more of its turning echo, its turn may have been uneven: with a speed that varies
by 1 % the residual of a mug, a helmet or a box with its tag is 0.2 to 1.5 %."""
CLEARLY = 0.4
"""A capture is to blame where the residual without it is this part of the residual without any other."""
SAME_PLACE_M, SAME_TURN_RAD = 1e-3, np.deg2rad(15.0)
"""Captures nearer than both show the object in one pose."""
_ROUNDS, _SETTLED, _STEADYING = 5, 0.02, 3
_ROUND_TURNING = 0.5
"""Turning echo over noise under which an object counts as round: its turn is not seen."""


@dataclass(frozen=True, eq=False)
class Placed:
    """One capture within the joint estimate.

    Attributes:
        spectra: capture.
        pose: of the object.
        gain: (F,) complex G of `tagid.tags.bodies.signature`.
    """

    spectra: Spectra
    pose: Pose
    gain: NDArray[np.complex128]


@dataclass(frozen=True)
class Residual:
    """Residual of the joint estimate in one capture; energies in units of the noise of one value.

    Attributes:
        name: of the capture.
        energy: of the residual.
        expected: the energy for noise alone.
        turning: energy beyond the room and a body of revolution, noise subtracted.
        moving: energy beyond the room, noise subtracted.
    """

    name: str
    energy: float
    expected: float
    turning: float
    moving: float

    @property
    def excess(self) -> float:
        """Residual energy beyond noise, at least 0."""
        return max(self.energy - self.expected, 0.0)

    @property
    def share(self) -> float:
        """The excess as a share of the turning echo, 0 where nothing turns."""
        return min(self.excess / self.turning, 1.0) if self.turning > self.expected * _ROUND_TURNING else 0.0

    @property
    def over(self) -> float:
        """The excess over what noise and the model's error may leave; at most 0 where all is noise."""
        model = MODEL_SHARE * self.turning + MOVING_SHARE * self.moving
        return self.excess - NOISE_SLACK * self.expected - model

    @property
    def is_noise(self) -> bool:
        """Whether the residual is noise, within NOISE_SLACK, MODEL_SHARE and MOVING_SHARE."""
        return self.over <= 0


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint estimate.

    Attributes:
        signature: of the object, in the frame of the capture with the most views.
        placed: the captures with their poses and gains, in the order given.
        residuals: of each capture.
    """

    signature: Signature
    placed: tuple[Placed, ...]
    residuals: tuple[Residual, ...]


@dataclass(frozen=True)
class Named:
    """A capture's spectra with the name of the capture, for messages."""

    name: str
    spectra: Spectra


class Basis:
    """Least squares of the harmonics of an object of one radius, m, at wavenumbers (F,), rad/m."""

    def __init__(self, wavenumbers: NDArray[np.float64], radius_m: float) -> None:
        self.order = order_of(float(wavenumbers[-1]), radius_m)
        self.mask = order_mask(wavenumbers, radius_m, self.order)
        self.m = np.arange(-self.order, self.order + 1)

    def columns(self, placed: Placed) -> NDArray[np.complex128]:
        """(F, V, 2 M + 1) in units of the noise, without the room, with pose and gain applied."""
        at = Standpoint(placed.spectra, placed.pose.centre)
        near = near_field(placed.spectra.wavenumbers, self.order, placed.spectra.distance_m)
        scale = near * np.exp(-1j * self.m * placed.pose.turn_rad) * self.mask
        scale = scale * (placed.gain / np.sqrt(noise_of(placed.spectra)))[:, None]
        columns = at.carrier[..., None] * angular(at.azimuth, self.order)[None] * scale[:, None, :]
        return np.asarray(columns - columns.mean(axis=1, keepdims=True))

    def solve(
        self, captures: Collection[Placed], ridge: float = RIDGE
    ) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        """Harmonics (F, 2 M + 1), and the variance of one harmonic's noise (F,)."""
        size = len(self.m)
        gram = np.zeros((len(self.mask), size, size), complex)
        data = np.zeros((len(self.mask), size), complex)
        for capture in captures:
            columns = self.columns(capture)
            across = columns.conj().swapaxes(1, 2)
            gram += across @ columns
            data += (across @ _whitened(capture.spectra)[..., None])[..., 0]
        mean = np.einsum("fnn->f", gram).real / self.mask.sum(axis=1)
        load = np.full(size, ridge)
        load[self.order] *= ROUND_RIDGE
        diagonal = mean[:, None] * np.where(self.mask, load, 1.0)
        inverse = np.linalg.inv(gram + diagonal[:, :, None] * np.eye(size))
        harmonics = (inverse @ data[..., None])[..., 0]
        variance = np.einsum("fnk,fkl,fln->fn", inverse, gram, inverse).real
        turning = self.mask & (self.m != 0)
        noise = np.where(turning, variance, 0).sum(axis=1) / np.maximum(turning.sum(axis=1), 1)
        return harmonics, np.maximum(noise, 0)

    def residuals(
        self, captures: Collection[Placed], harmonics: NDArray[np.complex128]
    ) -> list[NDArray[np.complex128]]:
        """(F, V) of every capture, in units of its noise: what harmonics leave."""
        return [
            _whitened(capture.spectra) - (self.columns(capture) @ harmonics[..., None])[..., 0]
            for capture in captures
        ]


def _whitened(spectra: Spectra) -> NDArray[np.complex128]:
    return np.asarray(spectra.data / np.sqrt(noise_of(spectra)))


def best_gain(
    spectra: Spectra, signature: Signature, pose: Pose, *, split: bool = False
) -> NDArray[np.complex128]:
    """(F,) least-squares gain of a signature in a pose; of what turns alone where `split`."""
    column = centred(echo(spectra, signature, pose))
    if split:
        column = centred(echo(spectra, replace(signature, harmonics=signature.turning), pose))
        unit = centred(Standpoint(spectra, pose.centre).carrier)
        unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-9)
        column = column - np.sum(unit.conj() * column, axis=1, keepdims=True) * unit
    size = np.maximum(np.sum(np.abs(column) ** 2, axis=1), 1e-300)
    return np.asarray(np.sum(column.conj() * spectra.data, axis=1) / size)


class _Estimate:
    """State of the alternation between harmonics, poses and gains."""

    def __init__(self, captures: Sequence[Spectra], name: str, kind: SignatureKind, radius_m: float) -> None:
        self.captures, self.name, self.kind = captures, name, kind
        self.order = sorted(range(len(captures)), key=lambda i: -captures[i].views)
        self.placed: dict[int, Placed] = {}
        self.resize(radius_m)

    def resize(self, radius_m: float) -> None:
        """Begin harmonics of another radius, m."""
        first = self.captures[0]
        self.basis = Basis(first.wavenumbers, radius_m)
        ones = np.ones((len(first.wavenumbers), len(self.basis.m)), complex)
        noise, height = np.zeros(len(first.wavenumbers)), float(first.height_m.mean())
        at = radius_m, first.distance_m, height
        self.signature = Signature(self.name, self.kind, first.wavenumbers, ones, noise, *at)

    def start(self) -> None:
        """Harmonics of the capture with the most views; then every other capture, matched with them."""
        for i in self.order:
            spectra = self.captures[i]
            centre, residual = round_centre(spectra)
            around = (centre,) if residual < ROUND_SHARE * spectra.energy else ()
            if not self.placed:
                first = around[0] if around else 0j
                ones = np.ones(len(spectra.wavenumbers), complex)
                self.placed[i] = Placed(spectra, Pose((first.real, first.imag)), ones)
                self.solve(3e-3)
                continue
            search = PoseSearch(spectra, self.basis.order, around)
            # One capture does not tell its m = 0 from the room: what turns gives pose and gain.
            turns = residual > (1 + _ROUND_TURNING) * spectra.noise_energy
            near = matches(spectra, self.signature, search, split=turns)
            gains = [best_gain(spectra, self.signature, candidate.pose, split=turns) for candidate in near]
            placed = [
                Placed(spectra, candidate.pose, gain) for candidate, gain in zip(near, gains, strict=True)
            ]
            # What turns may look alike in several poses: an oval turned by a quarter is one with the gain
            # reversed. The gain must suit the round part of the echo, too.
            before = list(self.placed.values())
            residuals = [_residual_energy([*before, candidate], self.basis) for candidate in placed]
            self.placed[i] = placed[int(np.argmin(residuals))]
            self.solve(1e-3)

    def solve(self, ridge: float = RIDGE) -> None:
        """Harmonics for the present poses and gains."""
        harmonics, noise = self.basis.solve(self.placed.values(), ridge)
        self.signature = replace(self.signature, harmonics=harmonics, noise=noise)

    def alternate(self, rounds: int) -> None:
        """Poses and gains of all captures but the first, one by one, then the harmonics."""
        for _ in range(rounds):
            for i in self.order[1:]:
                spectra = self.placed[i].spectra
                pose = refine(spectra, self.signature, self.placed[i].pose).pose
                self.placed[i] = Placed(spectra, pose, best_gain(spectra, self.signature, pose))
            self.solve()

    def balance(self, steps: int = 3) -> None:
        """Gauss-Newton on the gains of all captures but the first, the harmonics eliminated.

        Gains and harmonics are a product: improved in turns, they creep towards their common best.
        """
        for _ in range(steps):
            harmonics, _ = self.basis.solve(self.placed.values())
            parts = {i: self.basis.columns(placed) for i, placed in self.placed.items()}
            columns = np.concatenate(list(parts.values()), axis=1)
            data = np.concatenate([_whitened(placed.spectra) for placed in self.placed.values()], axis=1)
            inverse = np.linalg.pinv(columns, rcond=RIDGE)
            slopes = np.zeros((*data.shape, len(self.order) - 1), complex)
            first = 0
            for i, part in parts.items():
                rows = slice(first, first + part.shape[1])
                first = rows.stop
                if i != self.order[0]:
                    slopes[:, rows, self.order.index(i) - 1] = (part @ harmonics[..., None])[..., 0]
            slopes = slopes - columns @ (inverse @ slopes)
            residual = data - (columns @ harmonics[..., None])[..., 0]
            change = (np.linalg.pinv(slopes) @ residual[..., None])[..., 0]
            before, kept = _residual_energy(self.placed.values(), self.basis), self.placed
            self.placed = {
                i: replace(placed, gain=placed.gain * (1 + change[:, self.order.index(i) - 1]))
                if i != self.order[0]
                else placed
                for i, placed in kept.items()
            }
            if _residual_energy(self.placed.values(), self.basis) > before:
                self.placed = kept
                break
        self.solve()

    def descend(self, iterations: int = 6) -> None:
        """Levenberg-Marquardt on the poses of all captures but the first, the harmonics eliminated."""
        moving = self.order[1:]
        if not moving:
            return
        steps = np.tile([2e-5, 2e-5, 2e-4], len(moving))
        x = np.concatenate([[*self.placed[i].pose.centre_m, self.placed[i].pose.turn_rad] for i in moving])

        def rest(x: NDArray[np.float64]) -> NDArray[np.float64]:
            now = self._moved(moving, x).values()
            parts = self.basis.residuals(now, self.basis.solve(now)[0])
            flat = np.concatenate([part.ravel() for part in parts])
            return np.concatenate([flat.real, flat.imag])

        e = rest(x)
        cost, damping = float(e @ e), 1e-3
        for _ in range(iterations):
            jacobian = np.stack([(rest(x + h) - e) / h[k] for k, h in enumerate(np.diag(steps))], axis=1)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ e
            # The rotation of a round body changes nothing: the load keeps such a row solvable.
            normal += 1e-9 * np.trace(normal) * np.eye(len(x)) * steps.min() ** 2
            gain = 0.0
            for _ in range(4):
                damped = normal + damping * np.diag(np.maximum(np.diag(normal), 1e-30))
                trial = x - np.linalg.solve(damped, gradient)
                e2 = rest(trial)
                if float(e2 @ e2) < cost:
                    gain = cost - float(e2 @ e2)
                    x, e, cost, damping = trial, e2, float(e2 @ e2), damping / 5
                    break
                damping *= 6
            if gain < 1e-5 * cost:
                break
        self.placed = self._moved(moving, x)
        self.solve()

    def steady(self) -> None:
        """Errors of the angles of all captures, one by one, then poses, gains and harmonics."""
        for _ in range(_STEADYING):
            for i, recorded in enumerate(self.captures):
                near, spectra = steadied(recorded, self.signature, self.placed[i].pose)
                # The frame is that of the first.
                pose = self.placed[i].pose if i == self.order[0] else near.pose
                self.placed[i] = replace(self.placed[i], spectra=spectra, pose=pose)
            self.solve()
            self.alternate(1)
            self.balance()

    def _moved(self, moving: list[int], x: NDArray[np.float64]) -> dict[int, Placed]:
        new = dict(self.placed)
        for i, (cx, cy, turn) in zip(moving, x.reshape(-1, 3), strict=True):
            new[i] = replace(self.placed[i], pose=Pose((float(cx), float(cy)), float(turn)))
        return new


def estimate(
    captures: Sequence[Named], name: str, kind: SignatureKind, radius_m: float | None = None
) -> Joint:
    """Joint signature of captures of one object that was turned and moved between them; not yet checked.

    They are at the same frequencies, of any number of views each. The radius is that of the object with its
    tag, m; None finds it by generalised cross-validation over RADII_M.
    """
    spectra = [capture.spectra for capture in captures]
    if radius_m is not None:
        work = _joint(spectra, name, kind, radius_m)
    else:
        # Few views alias a large radius, and a small one loses the rim: begin with both.
        begun = [_joint(spectra, name, kind, radius) for radius in START_RADII_M]
        work, chosen = min(
            ((start, radius) for start in begun for radius in RADII_M),
            key=lambda pair: _score(spectra, *pair),
        )
        if chosen != work.signature.radius_m:
            work.resize(chosen)
            work.solve()
            work.alternate(2)
            work.balance()
            work.descend()
    residuals = _residuals(captures, work)
    if any(residual.share > UNEVEN_SHARE for residual in residuals):
        work.steady()
        residuals = _residuals(captures, work)
    final = work.signature
    error = max(residual.share for residual in residuals)
    signature = replace(final, model_error=min(error, 1.0), captures=len(captures))
    return Joint(signature, tuple(work.placed[i] for i in range(len(captures))), residuals)


def _joint(spectra: Sequence[Spectra], name: str, kind: SignatureKind, radius_m: float) -> _Estimate:
    work = _Estimate(spectra, name, kind, radius_m)
    work.start()
    before = np.inf
    for _ in range(_ROUNDS):
        work.alternate(2)
        work.balance()
        work.descend()
        now = _residual_energy(work.placed.values(), work.basis)
        if now > (1 - _SETTLED) * before:
            break
        before = now
    return work


def _residual_energy(captures: Collection[Placed], basis: Basis) -> float:
    """Residual energy of captures after the least squares of a basis, in units of their noise."""
    residuals = basis.residuals(captures, basis.solve(captures)[0])
    return sum(float(np.sum(np.abs(residual) ** 2)) for residual in residuals)


def _score(spectra: Sequence[Spectra], work: _Estimate, radius_m: float) -> float:
    """Residual per squared share of the degrees of freedom, for a radius, at the poses found."""
    basis = Basis(spectra[0].wavenumbers, radius_m)
    return (
        _residual_energy(work.placed.values(), basis)
        / max(1 - int(basis.mask.sum()) / sum(capture.data.size for capture in spectra), 1e-3) ** 2
    )


def _residuals(captures: Sequence[Named], work: _Estimate) -> tuple[Residual, ...]:
    frequencies = len(work.basis.mask)
    freedom = [frequencies * (capture.spectra.views - 1) for capture in captures]
    spent = int(work.basis.mask.sum()) + (frequencies + 3) * (len(captures) - 1)
    share = max(1 - spent / sum(freedom), 0.05)
    residuals = []
    for i, capture in enumerate(captures):
        placed = work.placed[i]
        model = centred(echo(placed.spectra, work.signature, placed.pose))
        gain = best_gain(placed.spectra, work.signature, placed.pose)
        noise = noise_of(capture.spectra)
        energy = float(np.sum(np.abs(capture.spectra.data - gain[:, None] * model) ** 2)) / noise
        turning = round_centre(capture.spectra)[1] / noise - freedom[i]
        moving = capture.spectra.energy / noise - freedom[i]
        residuals.append(
            Residual(capture.name, energy, freedom[i] * share, max(turning, 0.0), max(moving, 0.0))
        )
    return tuple(residuals)


def enroll_signature(captures: Sequence[Named], name: str, kind: SignatureKind) -> Joint:
    """A signature that its captures confirm.

    Raises DataError: too few captures, other bands, nothing but noise, one pose in all captures, or a
    residual that is not noise; the capture to blame is named where one is.
    """
    if len(captures) < CAPTURES:
        raise DataError(
            f"{counted(len(captures), 'capture')} of {name}, a signature needs {CAPTURES}",
            "Record the object again, turned by about a third of a turn and moved by a few millimetres.",
        )
    first = captures[0].spectra
    for capture in captures:
        if capture.spectra.data.shape[0] != first.data.shape[0] or not np.allclose(
            capture.spectra.wavenumbers, first.wavenumbers, rtol=1e-4
        ):
            raise DataError(
                f"{capture.name} covers another band than {captures[0].name}",
                "Record all with one radar setting.",
            )
        noise = noise_of(capture.spectra) * capture.spectra.data.size
        if capture.spectra.energy < (1 + NOISE_SLACK) * noise:
            raise DataError(
                f"{capture.name} shows nothing but noise where the object should be",
                "Check that the object stands in the beam, and move it a few millimetres off the axis: what "
                "is round and exactly centred looks like the room.",
            )
    joint = estimate(captures, name, kind)
    if not all(residual.is_noise for residual in joint.residuals):
        raise _refusal(captures, joint, kind)
    _check_poses(captures, joint)
    return joint


def _check_poses(captures: Sequence[Named], joint: Joint) -> None:
    """Raise DataError where the object was not moved between the captures."""
    turns = any(r.turning > _ROUND_TURNING * r.expected for r in joint.residuals)
    poses = [placed.pose for placed in joint.placed]
    for i, a in enumerate(poses):
        for b in poses[:i]:
            moved = abs(a.centre - b.centre) > SAME_PLACE_M
            angle = abs(np.angle(np.exp(1j * (a.turn_rad - b.turn_rad))))
            if moved or (turns and angle > SAME_TURN_RAD):
                return
    raise DataError(
        "all captures show the object in the same place: an echo of the turntable could not be told from it",
        "Turn the object by about a third of a turn and move it by a few millimetres between captures; "
        f"{captures[0].name} can stay.",
    )


def _refusal(captures: Sequence[Named], joint: Joint, kind: SignatureKind) -> DataError:
    """The error that names the captures which do not show what the others show."""
    name = joint.signature.name
    groups = _odd_captures(captures, joint.signature, kind)
    worst = max(joint.residuals, key=lambda r: r.excess / r.expected)
    amount = f"{worst.energy / worst.expected:.1f} times the noise" + (
        f", {worst.share:.1%} of the turning echo" if worst.share else ""
    )
    if len(groups) == 1:
        odd = [capture.name for capture in groups[0]]
        verb, them = ("does", "it") if len(odd) == 1 else ("do", "them")
        same = "the same body, without a tag" if kind == "body" else "the same object, with its tag unchanged"
        return DataError(
            f"{' and '.join(odd)} {verb} not show what the other captures of {name} show: together they "
            f"leave {amount} unexplained, without {them} only noise",
            f"Leave {them} out or record again: {same}, standing firmly on the turntable. Nothing is stored.",
        )
    every = ", ".join(f"{r.name} {r.energy / r.expected:.1f}" for r in joint.residuals)
    suspects = [capture.name for group in groups for capture in group] or [worst.name]
    blame = f"{' or '.join(suspects)} " + ("may be to blame" if groups else "leaves most")
    return DataError(
        f"the captures of {name} do not agree: they leave more than noise ({every} times the noise); {blame}",
        "Check that all show the same object, standing firmly on a turntable whose angles are right, and "
        "record again; nothing was stored.",
    )


def _odd_captures(captures: Sequence[Named], signature: Signature, kind: SignatureKind) -> list[list[Named]]:
    """Captures without which the others leave only noise: one, or two where enough others remain.

    Several groups where each would do.
    """
    rest = []
    for i in range(len(captures)):
        others = [capture for k, capture in enumerate(captures) if k != i]
        rest.append(estimate(others, signature.name, kind, signature.radius_m))
    scores = [sum(r.excess / r.expected for r in joint.residuals) for joint in rest]
    order = sorted(range(len(captures)), key=lambda i: scores[i])
    good = [i for i in order if all(r.is_noise for r in rest[i].residuals)]
    # Two captures share what differs between them, so a pair may pass that three refute: the exclusion that
    # leaves far less than any other counts.
    if len(good) > 1 and scores[good[0]] < CLEARLY * scores[good[1]]:
        good = good[:1]
    if good or len(captures) < CAPTURES + 2:
        return [[captures[i]] for i in good]
    first = captures[order[0]]
    others = [capture for capture in captures if capture is not first]
    return [[first, *group] for group in _odd_captures(others, signature, kind) if len(group) == 1]
