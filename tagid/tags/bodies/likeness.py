"""How alike enrolled bodies and objects are, and how strong a tag on a body must be to be read.

Answered from the signatures alone, before any capture: one signature's echo is matched with the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tagid.tags.bodies.posing import match, round_centre
from tagid.tags.bodies.signature import Pose, Signature, echo, same_wavenumbers
from tagid.tags.bodies.spectra import Spectra, centred

VIEWS = 90
OFF_AXIS_M = 0.004
"""Where the body stands in the comparison: on the axis a round part would be hidden in the room."""
ALIKE = 0.02
"""Share of the turning echo under which two signatures are taken for each other: a third of what one missing
reflector of a tag 17 dB under its body's echo leaves is noise and model error."""
UNEXPLAINED = 0.15
"""Share of a tag's echo that its layout may leave on a body: the model error of the body must be under it."""
LEAST_ERROR = 2e-4
"""Model error that is taken for granted, as a share of the turning echo: full-wave objects at the distance of
their enrollment."""


@dataclass(frozen=True)
class Likeness:
    """Two signatures compared.

    Attributes:
        first, second: names.
        kind: of both.
        difference: share of the first's turning echo that the second does not explain, the smaller of both
            ways; 1 where the bands differ.
    """

    first: str
    second: str
    kind: str
    difference: float

    @property
    def alike(self) -> bool:
        """Whether one would be taken for the other."""
        return self.difference < ALIKE


def spectra_of(signature: Signature) -> Spectra:
    """The echo of a signature as noiseless spectra of a uniform turn at its own distance."""
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    antenna = signature.distance_m * np.exp(-1j * angles)
    height = np.full(VIEWS, signature.height_m)
    empty = np.zeros((len(signature.wavenumbers), VIEWS), complex)
    noise = float(signature.noise.mean())
    bare = Spectra(empty, signature.wavenumbers, antenna, height, signature.distance_m, noise)
    return replace(bare, data=centred(echo(bare, signature, Pose((OFF_AXIS_M, 0.0)))))


def compare(signature: Signature, other: Signature) -> Likeness:
    """How alike two signatures are, over all poses."""
    if not same_wavenumbers(signature.wavenumbers, other.wavenumbers):
        return Likeness(signature.name, other.name, signature.kind, 1.0)
    shares = []
    for first, second in ((signature, other), (other, signature)):
        spectra = spectra_of(first)
        turning = round_centre(spectra)[1]
        residual = match(spectra, second).residual
        # A round body turns with nothing but noise, and is alike every round body.
        noise = first.noise_share * turning
        shares.append((residual - noise) / max(turning - noise, 1e-3 * spectra.energy))
    return Likeness(signature.name, other.name, signature.kind, float(np.clip(min(shares), 0, 1)))


def least_tag(signature: Signature) -> float:
    """Energy that a tag must add to be read on this body, over the body's whole echo, apart from noise.

    The body's signature is wrong by its model error, and its layout may leave UNEXPLAINED of the tag's echo.
    """
    error = max(signature.model_error, LEAST_ERROR) * max(signature.turning_share, LEAST_ERROR)
    return error / UNEXPLAINED
