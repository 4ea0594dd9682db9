"""Objects of ideal points and a round wall, drawn with exact distances: waves that no harmonics made."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.pipeline.identify import aspect_spectra
from tagid.tags.bodies import joint
from tagid.tags.bodies.joint import Named
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.waveform import nominal_pulse, pulse_at

WALL_M = 0.035


@dataclass(frozen=True)
class Thing:
    """An object: points in its own frame (x + jy, m) with amplitudes, and a round wall's amplitude."""

    points: tuple[complex, ...]
    amplitudes: tuple[complex, ...]
    wall: float = 0.0

    def plus(self, other: Thing) -> Thing:
        """Both together."""
        return Thing(self.points + other.points, self.amplitudes + other.amplitudes, self.wall + other.wall)


def ring(*degrees: float, radius: float = 0.045, amplitude: float = 1.0) -> Thing:
    """Alike reflectors on a ring."""
    points = tuple(complex(radius * np.exp(1j * np.deg2rad(d))) for d in degrees)
    return Thing(points, (amplitude,) * len(points))


MUG = Thing((0.05 + 0.01j, 0.06 + 0.004j, 0.052 - 0.012j), (2.5, 2.0 + 1j, -1.5), wall=6.0)
"""A round wall with a handle, 6 to 15 dB over a reflector."""
TAG = ring(100, 190)
"""Two reflectors 90 degrees apart: the layout container-90."""


def capture(
    thing: Thing,
    seed: int,
    *,
    centre: complex = 0j,
    rotation: float = 0.0,
    views: int = 48,
    distance: float = 1.0,
    noise: float = 0.05,
    room: float = 3.0,
) -> Capture:
    """A capture of a thing at `centre`, turned by `rotation`; `noise` is relative to a reflector."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.arange(views) / views
    antenna = distance * np.exp(-1j * angles)
    pulse = nominal_pulse()
    ranges = distance - 0.45 + RANGE_STEP_M * np.arange(99)
    samples = np.zeros((views, len(ranges)))

    def add(at: NDArray[np.float64], amplitude: complex) -> None:
        time = 2 * (ranges[None] - at[:, None]) / SPEED_OF_LIGHT
        samples[:] += (amplitude * pulse_at(pulse, time)).real

    across = np.abs(antenna - centre)
    if thing.wall:
        add(across - WALL_M, thing.wall * (distance / across.mean()) ** 2)
    for point, amplitude in zip(thing.points, thing.amplitudes, strict=True):
        place = centre + point * np.exp(1j * rotation)
        add(np.abs(antenna - place), amplitude)
    for offset, level in zip(rng.uniform(-0.4, 0.4, 3), rng.uniform(-room, room, 3), strict=True):
        add(np.full(views, distance + offset), level)
    samples += noise * rng.standard_normal(samples.shape)
    return Capture(
        (1000 * samples).astype(np.float32),
        float(ranges[0]),
        RANGE_STEP_M,
        angles_rad=angles,
        axis_distance_m=distance,
    )


PLACES = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
"""Centres and turns of the captures that a signature is made of."""


@cache
def enrolled(thing: Thing, name: str, kind: SignatureKind) -> Signature:
    """The signature of a thing from three captures."""
    captures = [
        Named(f"{name}{i}", aspect_spectra(capture(thing, i, centre=centre, rotation=turn)))
        for i, (centre, turn) in enumerate(PLACES)
    ]
    return joint.enroll_signature(captures, name, kind).signature
