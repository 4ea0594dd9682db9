"""The differentiable forward model: reflectivity of the pixels in, synthesized range profiles out.

It is the sparse operator that backprojection and sparse recovery use too, with its exact adjoint as the
gradient, so that the methods differ in their prior and in nothing else.

What the paper (eq. 2 to 6) leaves open, and how it is decided here:

* The paper's discrete model drops the pulse s(t), which asks the reflectivity to carry the carrier's ripple.
  Here every pixel gives response(R - d) exp(-2jkd): pulse and matched filter are part of the model.
* sigma is "real" in one place and complex in another: here it is complex, one value a pixel.
* Transmission T is 1. The printed model multiplies by 2T in r(t) and again in L (the related sonar code
  squares T instead), and -log T = sum |sigma| dl is only defined up to the unknown scale of sigma; on a
  planar scene of a few reflectors nothing hides behind anything, and T = 1 keeps the model linear, with a
  known best gradient.
* The Lambertian term L as printed is a vector (no surface normal occurs in it); it is left out, so
  reflectors are points that answer equally to all sides. A far side that is dimmer comes out as a smaller
  amplitude.
* The directivity b_T and the constant 2 / (4 pi)^3 R^-4 are left out: over an object that is small beside its
  distance they are one factor, which the scale of sigma takes.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray


class LinearOperator(Protocol):
    """What the fit needs of `tagid.imaging.operator.ForwardOperator`."""

    def forward(self, sigma: NDArray[Any]) -> NDArray[Any]:
        """(P,) complex reflectivity -> (views, bins) complex."""
        ...

    def adjoint(self, samples: NDArray[Any]) -> NDArray[Any]:
        """(views, bins) complex -> (P,) complex, the exact conjugate transpose of `forward`."""
        ...


class _Synthesis(torch.autograd.Function):  # type: ignore[misc]
    """y = A sigma; a real loss's gradient by sigma is A^H times that by y (torch's conjugate convention)."""

    @staticmethod
    def forward(ctx: Any, sigma: Any, operator: LinearOperator) -> Any:
        ctx.operator = operator
        ctx.dtype = sigma.dtype
        return torch.from_numpy(np.ascontiguousarray(operator.forward(sigma.detach().numpy())))

    @staticmethod
    def backward(ctx: Any, grad: Any) -> Any:
        pulled = ctx.operator.adjoint(grad.contiguous().resolve_conj().numpy())
        return torch.from_numpy(np.ascontiguousarray(pulled)).to(ctx.dtype), None


def synthesize(sigma: Any, operator: LinearOperator) -> Any:
    """Range profiles that the reflectivity would give.

    Args:
        sigma: (P,) complex tensor, row-major (y, x) pixels.
        operator: the forward model of the views wanted.

    Returns:
        (views, bins) complex tensor, differentiable by sigma.
    """
    return _Synthesis.apply(sigma, operator)
