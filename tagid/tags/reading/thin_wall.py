"""The echo of a thin round wall below the reflectors: one more wave, and the scans without it.

Before a helmet's shell or in a plastic cup, reflectors are seen from all sides as they are without a body,
and the wall adds one flash from the side that faces the antenna. About the layout's centre c its distance is
|a - c| - R in every view, whatever its material: one amplitude and one radius. Left in the scans, it passes
for a reflector too many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import Fit
from tagid.tags.reading.squares import least_squares

LEAST_NATS = 5.0
"""Energy that a wall must explain beyond the layout: noise reaches it in some hundredths of recordings."""
MOST_STRENGTH = 0.65
"""Largest amplitude of the wall over the mean of the layout's reflectors, that of a reflector that is missing
(`DecisionSettings.missing_share`). A wave about the centre is also what a reflector in the centre sends, and
one that is alike belongs to another tag,"""
WALL_NATS = 4.0
"""but only where a wave from the centre itself explains nearly as much, up to this."""
RADIUS_STEP_M = 4e-3
_LEFT_OVER = 0.05
"""Share of a wave's energy that must be its own, beyond the layout's reflectors."""


@dataclass(frozen=True, eq=False)
class ThinWall:
    """A round wall about the layout's centre.

    Attributes:
        radius_m: R, m: known to the range resolution only.
        nats: energy that it explains beyond the layout, over the noise.
        strength: amplitude over the mean of the layout's reflectors.
        scans: without its echo.
    """

    radius_m: float
    nats: float
    strength: float
    scans: BasebandScans


def thin_wall(scans: BasebandScans, field: MatchedField, best: Fit) -> ThinWall | None:
    """The wall that explains most beyond a layout's fit; None where it explains too little, or is too strong.

    Args:
        scans: those of the field.
        field: matched field.
        best: the layout's fit, whose centre is the wall's.
    """
    own = best.look.templates(field, best.places)
    away = field.distances(np.asarray(best.centre_m)[None]) + best.offset_m
    # The wall carries the reflectors, so that it lies inside them.
    radii = np.arange(0.0, best.layout.radius_m + RADIUS_STEP_M, RADIUS_STEP_M)
    waves = field.templates(away - radii[:, None])
    gram = field.gram(own)
    b = field.correlate(own)
    amplitudes, _ = least_squares(b, gram)
    rest = field.data - amplitudes.astype(np.complex64) @ own
    seen = (waves @ rest.conj()).conj()
    shared = own.conj() @ waves.T
    loaded = gram + 1e-6 * np.trace(gram).real * np.eye(len(gram))
    taken = np.real(np.sum(shared.conj() * np.linalg.solve(loaded, shared), axis=0))
    whole = np.sum(np.abs(waves) ** 2, axis=1)
    left = np.maximum(whole - taken, _LEFT_OVER * field.template_energy)
    gain = np.abs(seen) ** 2 / left
    i = int(np.argmax(gain))
    nats = float(gain[i]) / max(field.noise_variance, 1e-30)
    if nats < LEAST_NATS:
        return None
    both = np.concatenate([own, waves[i : i + 1]])
    fitted, _ = least_squares(field.correlate(both), field.gram(both))
    usual = float(np.mean(np.abs(fitted[:-1])))
    strength = float(np.abs(fitted[-1])) / max(usual, 1e-30)
    central = nats - float(gain[0]) / max(field.noise_variance, 1e-30) < WALL_NATS
    if central and strength > MOST_STRENGTH:
        return None
    samples = field.samples_without(scans.samples, (fitted[-1] * waves[i]).astype(np.complex64))
    return ThinWall(float(radii[i]), nats, strength, replace(scans, samples=samples))
