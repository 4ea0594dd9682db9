"""The linear solution: least squares on the pixels by conjugate gradients, ended early.

The first iteration is backprojection times the factor that explains the scans best; each further one
sharpens the image and amplifies noise. The number of iterations is its only regularisation (Hanke, Conjugate
Gradient Type Methods for Ill-Posed Problems, 1995).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tagid.imaging.operator import ForwardOperator
from tagid.types import Samples


def least_squares(operator: ForwardOperator, scans: Samples, iterations: Sequence[int]) -> Iterator[Samples]:
    """Minimise ||A x - y||^2 from zero (CGLS; Hestenes and Stiefel, J. Res. NBS 49, 1952).

    Args:
        operator: A.
        scans: y, (views, bins) complex64.
        iterations: numbers of iterations after which x is wanted, ascending.

    Yields:
        x (points,) complex64 after each number of iterations.
    """
    x = np.zeros(operator.points, dtype=np.complex64)
    rest = np.asarray(scans, dtype=np.complex64).copy()
    slope = operator.adjoint(rest)
    direction, power = slope.copy(), float(np.vdot(slope, slope).real)
    for done in range(1, max(iterations) + 1):
        if power > 0:
            seen = operator.forward(direction)
            energy = float(np.vdot(seen, seen).real)
            length = np.float32(power / energy if energy > 0 else 0.0)
            x = x + length * direction
            rest -= length * seen
            slope = operator.adjoint(rest)
            before, power = power, float(np.vdot(slope, slope).real)
            direction = slope + np.float32(power / before) * direction
        if done in iterations:
            yield x
