"""Where the search begins: nothing, or a round body, and the clutter that it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tagid.reading.columns import Model, Priors
from tagid.reading.descent import Estimate, Powers, best_powers, refined
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.types import Floats

GRID_M = tuple(complex(x, y) for x in 4e-3 * np.arange(-2, 3) for y in 4e-3 * np.arange(-2, 3))
"""Centres that are tried, x + jy."""
SHAPES_M = tuple(r * np.exp(1j * np.pi / 3 * np.arange(6)) for r in (4e-3, 8e-3, 12e-3))
"""Two-fold parts of a body's support function that are tried, m."""
BODIES_M = (*((c, 0j) for c in GRID_M), *((0j, complex(s)) for ring in SHAPES_M for s in ring))
"""Centres and shapes of a body that are tried."""
LEAST_CLUTTER = 1e-3
"""Least power of the clutter under which reflectors are looked for: a body alone takes some of theirs."""


@dataclass(frozen=True, eq=False)
class RoundBodies:
    """A round body in the clutter of either disc.

    Attributes:
        estimates: of the likeliest starts, for each disc.
    """

    estimates: Sequence[Sequence[Estimate]]

    @cached_property
    def of_disc(self) -> list[Estimate]:
        """The best of each disc."""
        return [max(some, key=lambda estimate: estimate.log_z) for some in self.estimates]

    @property
    def best(self) -> Estimate:
        return max(self.of_disc, key=lambda estimate: estimate.log_z)

    @property
    def powers(self) -> list[Powers]:
        """Under which reflectors are looked for, for each disc."""
        return [with_clutter(estimate.powers) for estimate in self.of_disc]

    @property
    def shapes(self) -> list[Floats]:
        """(2,) two-fold parts of the support function, m, for each disc."""
        return [estimate.x[2:4] for estimate in self.of_disc]


def with_clutter(powers: Powers) -> Powers:
    """Powers with `LEAST_CLUTTER` at least."""
    return replace(powers, clutter=max(powers.clutter, LEAST_CLUTTER))


def round_bodies(spectra: Spectra, priors: Priors) -> RoundBodies:
    """A round body in the clutter of either disc."""
    model = Model(POINTS, None, True, 0, levels=spectra.levels, priors=priors)
    starts = [np.array([c.real, c.imag, s.real, s.imag]) for c, s in BODIES_M]
    values = [best_powers(spectra, model, x, 1e-2)[1] for x in starts]
    order = np.argsort(values)[::-1][:2]
    models = [replace(model, disc=disc) for disc in (0, 1)]
    return RoundBodies([[refined(spectra, m, starts[i], (1e-2, None), 12) for i in order] for m in models])


def nothing(spectra: Spectra, priors: Priors) -> list[Estimate]:
    """No body, in the clutter of either disc."""
    models = [Model(BARE, None, False, disc, levels=spectra.levels, priors=priors) for disc in (0, 1)]
    return [refined(spectra, model, np.zeros(2), (None,), 1) for model in models]
