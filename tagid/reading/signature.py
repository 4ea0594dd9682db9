"""An enrolled body, or an object enrolled with its tag: its measured echo, at any turn and place.

The echo is that of `tagid.tags.bodies.signature`; two columns: the echo, whose amplitude at every frequency
takes up another pulse, and its change from one frequency to the next, which takes up that the tail of another
pulse is cut by the range window: of what a depth r returns late by tau the window keeps W(tau) + r W'(tau),
and a factor r is a slope over the wavenumber. The parameters of a model begin with those
of the body: its centre x, y, its turn, how uneven the turn was, and how oval its wall is, which turns the
reflectors on it. Those of `tagid.reading.columns.Model` follow; their centre is that of the tag about the
body's. Every harmonic of an object may differ a little from the enrolled one, with a random phase: the
variance of that is the same whichever way it is turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import BasebandScans
from tagid.reading.columns import Columns, Model, Priors, table_of
from tagid.reading.descent import Estimate
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import POINTS
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.uneven import CYCLES_RAD, cycles, spin
from tagid.tags.bodies.signature import (
    FREQUENCY_STEP_HZ,
    Signature,
    angular,
    near_field,
    same_wavenumbers,
)
from tagid.types import Complex, Floats

SLOPE = 0.2
"""Standard deviation of the amplitude of an echo's change from one frequency to the next, 0.2 GHz away, over
that of the echo itself: with measured P440 pulses against a nominal one at the enrollment 0.14 to 0.22, at
the ends of the band 0.24 and 0.43 (24 bodies of our simulator)."""
ECHO_ERROR = 0.1
"""Amplitude by which every harmonic of an echo differs from the enrolled one, over its own."""
TILT_RAD = 0.1
"""Standard deviation of the angle between a wall's normal and the direction from its centre, cosine and sine
of two cycles round the body, rad: (a^2 - b^2) / (a^2 + b^2) of an ellipse with semi-axes 10 % apart."""
_TURNED = 3 + 2 * len(CYCLES_RAD)
HEAD = _TURNED + 2
"""Parameters of the body: centre, turn, how uneven the turn was, how the normals of its wall are tilted."""
OWN = 2
"""Columns of the body."""
EDGE = 0.02
"""The edges of a recording's band are known to this, over the step of the frequencies of signatures."""
TAG_SD_M = 5e-3
"""Standard deviation of a tag's centre about the body's, m, which is where its first capture had the axis."""


@dataclass(frozen=True, eq=False)
class EnrolledBody:
    """A signature without what is only its noise.

    Attributes:
        signature: as enrolled.
        harmonics: (F, 2 M + 1) its harmonics behind Wiener's filter, over the root of their energy.
    """

    signature: Signature
    harmonics: Complex

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, signature: Signature) -> EnrolledBody:
        """That of a signature."""
        energy = np.abs(signature.harmonics) ** 2
        kept = np.maximum(1 - signature.noise[:, None] / np.maximum(energy, 1e-300), 0)
        harmonics = signature.harmonics * kept
        size = np.sqrt((np.abs(harmonics) ** 2).sum(axis=1, keepdims=True))
        return cls(signature, harmonics / np.maximum(size, 1e-300))

    @cached_property
    def error(self) -> Floats:
        """(F, 2 M + 1) variance of the turning harmonics, over the energy of all."""
        signature = self.signature
        energy = np.abs(signature.harmonics) ** 2
        noise = np.minimum(signature.noise[:, None], energy)
        error = ECHO_ERROR**2 * (energy - noise) + noise
        error[:, self.order] = 0.0
        return np.asarray(error / np.maximum((energy - noise).sum(axis=1, keepdims=True), 1e-300))

    @property
    def order(self) -> int:
        """M, the largest harmonic."""
        return self.signature.order

    def at(self, spectra: Spectra) -> Complex:
        """(F, 2 M + 1) harmonics as they arrive at the recording's distance."""
        near = near_field(spectra.kappa, self.order, spectra.distance_m)
        return self.nearest(self.harmonics, spectra.kappa) * near

    def nearest(self, values: NDArray[Any], kappa: Floats) -> NDArray[Any]:
        """(F, ..) values at the frequencies of the signature that are nearest to wavenumbers (F,), rad/m."""
        every = np.abs(self.signature.wavenumbers - kappa[:, None]).argmin(axis=1)
        return np.asarray(values[every])


@dataclass(frozen=True, eq=False)
class SignatureModel(Model):
    """A hypothesis with an enrolled body.

    Attributes:
        enrolled: the body.
        level: (F,) energy of its echo, by which what differs from the enrolled one is measured; None: nothing
            differs.
    """

    enrolled: EnrolledBody | None = None
    level: Floats | None = None

    @classmethod
    def of(
        cls, enrolled: EnrolledBody, transfer: Transfer, disc: int, levels: int = 1, priors: Priors = Priors()
    ) -> SignatureModel:
        """An untagged one."""
        return cls(transfer, None, False, disc, levels=levels, priors=priors, enrolled=enrolled)

    @property
    def body(self) -> EnrolledBody:
        assert self.enrolled is not None
        return self.enrolled

    @property
    def body_parameters(self) -> int:
        return HEAD

    @property
    def body_columns(self) -> int:
        return OWN

    @property
    def columns(self) -> int:
        return OWN + self.rest.columns

    @property
    def covers_middle(self) -> bool:
        """What stands in the middle does not look like this body."""
        return False

    @property
    def whole(self) -> bool:
        """The object was enrolled with its tag."""
        return self.body.signature.kind == "object"

    @property
    def identity(self) -> str | None:
        """Name of the object that was enrolled with its tag, as it was."""
        as_it_was = self.whole and self.tag is None and self.odd == 0
        return self.body.signature.name if as_it_was else None

    @property
    def tagged(self) -> bool:
        """It has reflectors: at least those with which the object was enrolled."""
        return self.tag is not None or self.whole

    @property
    def words(self) -> str:
        return f"the enrolled {self.body.signature.kind} {self.body.signature.name}"

    @cached_property
    def rest(self) -> Model:
        """What stands beside the body."""
        beside = self.disc, self.odd, self.hidden, self.levels, self.priors, self.faces
        return Model(_alone(self.transfer), self.tag, False, *beside)

    def error(self, spectra: Spectra) -> Floats | float:
        return 0.0 if self.level is None else self.level[:, None] * _error(self.body, spectra, self.disc)

    def levelled(self, spectra: Spectra, x: Floats) -> SignatureModel:
        """The same with the level of the echo at parameters x (P,)."""
        echo = spectra.whiteners[self.disc].apply(self.at(spectra, x, slopes=False).values[:, :1])[:, 0]
        along = np.abs((echo.conj() * spectra.white[self.disc]).sum(axis=1))
        return replace(self, level=(along / (np.abs(echo) ** 2).sum(axis=1)) ** 2)

    def with_guest(self, guest: Estimate, head: Floats) -> tuple[SignatureModel, Floats]:
        """The body (HEAD,) beside the reflectors of another hypothesis, and the parameters."""
        model = guest.model
        transfer = model.transfer if model.transfer.body else POINTS
        centre, turn, stretch, _ = model.split(guest.x)
        off = centre - complex(head[0], head[1])
        joined = replace(self, transfer=transfer, tag=model.tag, disc=model.disc)
        return joined, np.r_[head, off.real, off.imag, turn, stretch, np.zeros(joined.lifts)]

    def power(self, moving: Floats, body: float, tag: float, oval: float) -> Floats:
        body_powers = moving[:, None] * body * np.array([1.0, SLOPE**2])
        return np.concatenate([body_powers, self.rest.power(moving, body, tag, oval)], axis=1)

    def _sds(self) -> Floats:
        rest = super()._sds()
        rest[:2] = TAG_SD_M
        turn, uneven = 2 * np.pi / np.sqrt(12), np.repeat(CYCLES_RAD, 2)
        return np.asarray(np.r_[[self.priors.centre_m] * 2, turn, uneven, [TILT_RAD] * 2, rest])

    @cached_property
    def _normal(self) -> NDArray[np.bool_]:
        return np.concatenate([np.arange(HEAD) != 2, super()._normal])

    def _log_prior(self, x: Floats) -> tuple[float, Floats, Floats]:
        log, slope, hessian = super()._log_prior(x)
        return log - float(np.log(2 * np.pi)), slope, hessian

    def at(self, spectra: Spectra, x: Floats, slopes: bool = True) -> SignatureColumns:
        beside = np.append(x[:2] + x[HEAD : HEAD + 2], x[HEAD + 2 :])
        # What stands beside the body turns with it, as unevenly.
        rows = cycles(spectra.direction)
        turned = replace(spectra, antenna=spectra.antenna * np.exp(-1j * (x[3:_TURNED] @ rows)))
        rest = Columns.of(self.rest, turned, beside, slopes, tilt=x[_TURNED:HEAD])
        return SignatureColumns(self, turned, x, rows, rest)


@dataclass(frozen=True, eq=False)
class SignatureColumns:
    """Columns of an enrolled body and of what stands beside it, at some parameters.

    Attributes:
        spectra: with the antenna where it stands in the frame of the body, which turned unevenly.
        cycles: (2 K, V) cosine and sine of every cycle of the error of the angles.
    """

    model: SignatureModel
    spectra: Spectra
    x: Floats
    cycles: Floats
    rest: Columns

    @cached_property
    def _carrier(self) -> tuple[Complex, Floats]:
        waves, range_m = self.spectra.waves(np.array([self._centre]), np.zeros(1))
        return waves[:, 0], range_m[0]

    @property
    def _centre(self) -> complex:
        return complex(self.x[0], self.x[1])

    @cached_property
    def _patterns(self) -> tuple[Complex, Complex]:
        """(F, V) the body's pattern and its slope over the aspect."""
        body = self.model.body
        aspect = np.angle(self.spectra.antenna - self._centre) - self.x[2]
        basis, weights = angular(aspect, body.order).T, body.at(self.spectra)
        return weights @ basis, (weights * (1j * np.arange(-body.order, body.order + 1))) @ basis

    @cached_property
    def values(self) -> Complex:
        echo = self._carrier[0] * self._patterns[0]
        return np.concatenate([np.stack([echo, np.gradient(echo, axis=0)], axis=1), self.rest.values], axis=1)

    def slopes(self, weights: Complex) -> Complex:
        (carrier, range_m), (pattern, bent) = self._carrier, self._patterns
        across = self.spectra.antenna - self._centre
        echo, turned = carrier * pattern, carrier * bent
        moved = echo * (-1j * self.spectra.kappa[:, None] - 2 / range_m) / -range_m
        around = turned / np.abs(across) ** 2
        placed = [moved * across.real + around * across.imag, moved * across.imag - around * across.real]
        ahead = 1j * self.spectra.antenna
        uneven = placed[0] * ahead.real + placed[1] * ahead.imag
        body_slopes = np.stack([*placed, -turned, *(uneven * cycle for cycle in self.cycles)])
        body_slopes = body_slopes * weights[:, 0] + np.gradient(body_slopes, axis=1) * weights[:, 1]
        beside = self.rest.slopes(weights[:, OWN:])
        body_slopes[:2] += beside[:2]
        beside, tilted = np.split(beside, [self.rest.model.parameters])
        tilt = self.x[_TURNED:HEAD]
        # The wall turns with all that stands on it.
        turned_wall = 2 * (tilt[1] * tilted[0] - tilt[0] * tilted[1])
        body_slopes[3:] += (
            np.tensordot(spin(self.rest.model, self.rest.x), beside, 1) - turned_wall
        ) * self.cycles[:, None]
        return np.concatenate([body_slopes, tilted, beside])


@lru_cache(maxsize=64)
def _alone(transfer: Transfer) -> Transfer:
    """The same transfer without the body's echo, which shares its tables."""
    return replace(transfer, body=False, table=partial(_table, transfer))


def _table(transfer: Transfer, kappa: Floats, radius_m: float) -> Complex:
    return table_of(transfer, kappa.tobytes(), radius_m)


@lru_cache(maxsize=64)
def _error(body: EnrolledBody, spectra: Spectra, disc: int) -> Floats:
    """(F, M) variance of a unit echo in the basis of a clutter's disc, whichever way it is turned."""
    waves = angular(spectra.direction, body.order).T
    waves = np.broadcast_to(waves, (len(spectra.kappa), *waves.shape))
    basis = np.abs(spectra.whiteners[disc].apply(waves)) ** 2
    return np.asarray((body.nearest(body.error, spectra.kappa)[:, None] @ basis)[:, 0])


def enrolled_in(scans: BasebandScans, signatures: Sequence[Signature]) -> tuple[EnrolledBody, ...]:
    """The signatures of the band of a recording: those at all multiples of a step that lie in it."""
    edges_hz = (scans.center_hz or scans.carrier_hz) + scans.bandwidth_hz * np.array([-0.5, 0.5])
    low, high = edges_hz / FREQUENCY_STEP_HZ
    enrolled_bodies: list[EnrolledBody] = []
    for signature in signatures:
        first, last = signature.frequencies_hz[[0, -1]] / FREQUENCY_STEP_HZ
        inside = -EDGE < first - low < 1 + EDGE and -EDGE < high - last < 1 + EDGE
        if inside and (
            not enrolled_bodies
            or same_wavenumbers(signature.wavenumbers, enrolled_bodies[0].signature.wavenumbers)
        ):
            enrolled_bodies.append(EnrolledBody.of(signature))
    return tuple(enrolled_bodies)
