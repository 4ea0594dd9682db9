"""Which pixels can be bright: the sparsity prior keeps the others at zero, and a step need not compute them.

A minimum of 1/2 ||A sigma - y||^2 + w sum |sigma| has sigma_p = 0 wherever |A^H (y - A sigma)|_p < w: the
optimality condition by which `tagid.imaging.sparse` chooses its active set. Here it is checked a few times
during the fit. An image of points has a few hundred pixels that can be bright; an outline under a weak prior
has nearly all, and then nothing is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CHECK_AT = (0.1, 0.25, 0.45, 0.65)
"""Parts of the steps after which the pixels are chosen again."""

_FIRST_SHARE = 0.1
"""Backprojection over its maximum from which a pixel takes part in the first steps."""

_FAINT = 0.02
"""Part of the brightest pixel under which a pixel that the data do not ask for is dropped."""

_ASKING = 0.5
"""Part of the largest correlation with the residual from which a pixel joins: what is fainter may be a
sidelobe of what the fit has not explained yet, and is looked at again in the next check."""

_MOST_SHARE = 0.9
"""With more than this share of the pixels chosen, all are: a smaller step would save nothing."""


@dataclass(frozen=True, eq=False)
class Support:
    """Pixels of a square image that a fit works on; the others are zero.

    Attributes:
        mask: (pixels, pixels) bool.
    """

    mask: NDArray[np.bool_]

    @classmethod
    def all(cls, pixels: int) -> Support:
        """Every pixel of an image of pixels x pixels."""
        return cls(np.ones((pixels, pixels), dtype=bool))

    @classmethod
    def begin(cls, strength: NDArray[np.floating], first: NDArray[np.floating], weight: float) -> Support:
        """Pixels of the first steps: where backprojection is bright, and those of the image to begin with.

        Args:
            strength: (pixels, pixels) |A^H y|.
            first: (pixels, pixels) magnitude of the image to begin with.
            weight: w.
        """
        bright = strength > max(weight, _FIRST_SHARE * float(strength.max()))
        return cls._of(bright | (first > _FAINT * float(first.max())))

    def renewed(
        self, magnitude: NDArray[np.floating], strength: NDArray[np.floating], weight: float
    ) -> Support:
        """Pixels after a check: the bright ones, those that the residual asks for, and their neighbours.

        Args:
            magnitude: (pixels, pixels) |sigma|, zero outside the support.
            strength: (pixels, pixels) |A^H (y - A sigma)|.
            weight: w.
        """
        bright = magnitude > _FAINT * float(magnitude.max())
        asked = strength > max(weight, _ASKING * float(strength.max()))
        return self._of(bright | asked)

    @property
    def numbers(self) -> NDArray[np.intp] | None:
        """Row-major numbers of the pixels; None where they are all."""
        return None if self.mask.all() else np.flatnonzero(self.mask)

    @classmethod
    def _of(cls, wanted: NDArray[np.bool_]) -> Support:
        wide = np.pad(wanted, 1)
        rows = wide[:-2] | wide[1:-1] | wide[2:]
        mask = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
        if not mask.any() or mask.mean() > _MOST_SHARE:
            return cls.all(len(mask))
        return cls(mask)
