"""Bessel functions of integer order for cylinders, all orders at once, by their recurrence.

J is recurred downwards (Miller's algorithm; Abramowitz and Stegun, 1964, section 9.12), where it is stable,
and Y upwards from Neumann's series (9.1.88). Arguments are those of bodies in a radar's band, |z| up to some
hundred, real or complex. scipy gives the same, but takes 100 MB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[Any]

_RESCALE = 1e200
"""Values beyond this are scaled down during the downward recurrence, whose scale is arbitrary."""


@dataclass(frozen=True, eq=False)
class Bessel:
    """Functions and derivatives of the orders 0..N along the last axis, real for real arguments.

    Attributes:
        j, y: J_n and Y_n.
        dj, dy: their derivatives.
    """

    j: Values
    y: Values
    dj: Values
    dy: Values

    @property
    def h2(self) -> Values:
        """The Hankel function of the second kind, J_n - j Y_n."""
        return np.asarray(self.j - 1j * self.y)

    @property
    def dh2(self) -> Values:
        """Its derivative."""
        return np.asarray(self.dj - 1j * self.dy)


def bessel(order: int, z: NDArray[np.number]) -> Bessel:
    """J and Y of the orders 0 to `order`, (..., order + 1), at arguments z (...), none of which is 0."""
    z = np.asarray(z)
    every = _downwards(z, order + 1)
    first, second = every[..., : order + 2], _second_kind(order + 1, z, every)
    return Bessel(first[..., :-1], second[..., :-1], _slopes(first), _slopes(second))


def first_kind(order: int, z: NDArray[np.number]) -> Values:
    """J of the orders 0 to `order` at arguments z (...), 0 included: (..., order + 1)."""
    return _downwards(np.asarray(z), order)[..., : order + 1]


def _downwards(z: Values, order: int) -> Values:
    """J of the orders 0 to somewhat more than `order` and |z|."""
    dtype = np.complex128 if np.iscomplexobj(z) else np.float64
    largest = float(np.abs(z).max(initial=0.0))
    most = 2 * (int(max(order, largest) + 15 * max(order, largest, 1.0) ** (1 / 3)) // 2 + 10)
    safe = np.where(z == 0, 1.0, z).astype(dtype)
    values = np.zeros((most + 2, *z.shape), dtype=dtype)
    values[most] = 1e-300
    for n in range(most, 0, -1):
        values[n - 1] = 2 * n / safe * values[n] - values[n + 1]
        large = np.abs(values[n - 1]) > _RESCALE
        if large.any():
            values[n - 1 :, large] /= _RESCALE
    # exp(-+ jz) = J_0 + 2 sum (-+ j)^n J_n; of the two, the one that is not small: then nothing cancels.
    sign = np.where(safe.imag >= 0, -1j, 1j) if np.iscomplexobj(z) else np.array(-1j)
    total = values[0].astype(np.complex128)
    power = np.ones(np.shape(sign), dtype=np.complex128)
    for n in range(1, most + 1):
        power = power * sign
        total = total + 2 * power * values[n]
    if dtype is np.float64:
        # J_0 + 2 sum J_2n = 1 is the real part for a phase of 0.
        values /= values[0] + 2 * values[2 : most + 1 : 2].sum(axis=0)
    else:
        values = values * (np.exp(sign * safe) / total)
    values = np.moveaxis(values[: most + 1], 0, -1)
    values[z == 0] = 0
    values[z == 0, 0] = 1
    return values


def _second_kind(order: int, z: Values, j: Values) -> Values:
    """Y of the orders 0 to `order`, from J of somewhat more."""
    k = np.arange(1, (j.shape[-1] - 1) // 2)
    sign = (-1.0) ** k
    logarithm = np.log(z / 2) + np.euler_gamma
    out = np.empty((*z.shape, max(order, 1) + 1), dtype=j.dtype)
    out[..., 0] = 2 / np.pi * logarithm * j[..., 0] - 4 / np.pi * (sign / k * j[..., 2 * k]).sum(axis=-1)
    odd = (sign / (2 * k) * (j[..., 2 * k - 1] - j[..., 2 * k + 1])).sum(axis=-1)
    out[..., 1] = 2 / np.pi * (logarithm * j[..., 1] - j[..., 0] / z) + 4 / np.pi * odd
    for n in range(1, order):
        out[..., n + 1] = 2 * n / z * out[..., n] - out[..., n - 1]
    return out[..., : order + 1]


def _slopes(values: Values) -> Values:
    """Derivatives of the orders 0..N of values of the orders 0..N + 1."""
    before = np.concatenate([-values[..., 1:2], values[..., :-2]], axis=-1)
    return np.asarray((before - values[..., 1:]) / 2)
