"""What a transfer is: the patterns that a reflector of a tag may have beside a body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ANGLES = 256
"""Aspects of a table, between which patterns are interpolated."""
MIDDLE_M = 0.016
"""A reflector nearer to the axis has no outward side: it is the same from all sides."""

Tables = Callable[[NDArray[np.float64], float], NDArray[np.complex128]]


@dataclass(frozen=True, eq=False)
class Transfer:
    """Patterns of the echo of a reflector relative to the same one in free space.

    Attributes:
        name: of the kind of surroundings.
        words: the same for people, after "on" or "beside".
        body: a body stands there, which returns a wave of its own.
        power: (P,) prior variances of the patterns' amplitudes, relative to the reflector's.
        table: function of wavenumbers kappa (F,), rad/m, and distance from the axis, m, that gives the
            patterns (P, F, ANGLES) at angles 2 pi i / ANGLES between outward direction and antenna.
        radius_sd_m: standard deviation of the ring's apparent radius, beyond the mounting's.
        open: waves pass from one reflector to another.
        clear: a reflector in the middle of the body shows as one in front does.
    """

    name: str
    words: str
    body: bool
    power: tuple[float, ...]
    table: Tables
    radius_sd_m: float = 0.0
    open: bool = False
    clear: bool = False


def aspects() -> NDArray[np.float64]:
    """(ANGLES,) of a table, rad."""
    return 2 * np.pi * np.arange(ANGLES) / ANGLES


def principal(members: NDArray[np.complexfloating], terms: int) -> NDArray[np.complex128]:
    """(terms, F, A) principal patterns of a class of equally likely ones.

    The amplitude has any phase, so that a pattern of the class has mean zero and a second moment over the
    aspects; its principal vectors, each as long as the root of its share of the mean energy, need powers of
    one (Karhunen and Loeve's expansion). Their phases are those of the members: the shares of the members in
    a pattern have the same phase at neighbouring frequencies, and their sum has none at the first.

    Args:
        members: (M, F, A) patterns of the class.
    """
    flat = np.swapaxes(members, 0, 1) / np.sqrt(len(members))
    if flat.shape[1] < flat.shape[2]:
        _, vectors = np.linalg.eigh(flat @ np.swapaxes(flat.conj(), 1, 2))
        best = np.swapaxes(vectors[..., ::-1][..., :terms].conj(), 1, 2) @ flat
    else:
        values, vectors = np.linalg.eigh(np.swapaxes(flat, 1, 2) @ flat.conj())
        best = vectors * np.sqrt(np.maximum(values, 0))[:, None]
        best = np.swapaxes(best[..., ::-1][..., :terms], 1, 2)
    shares = best.conj() @ members.transpose(1, 2, 0)
    turns = np.concatenate([shares[:1].sum(2), (shares[1:] * shares[:-1].conj()).sum(2)])
    best = best * np.exp(1j * np.cumsum(np.angle(turns), axis=0))[..., None]
    return np.ascontiguousarray(np.swapaxes(best, 0, 1))
