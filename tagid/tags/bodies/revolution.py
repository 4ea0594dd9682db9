"""A body of revolution: its echo depends on nothing but the distance of the antenna from its own centre.

A can of 35 mm radius returns 20 dB more than a 20 mm reflector. Standing 2 mm off the rotation axis it moves,
so subtracting the mean over the views does not remove it, but one complex amplitude per frequency does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.hypothesis import Candidate, Pose, Seen
from tagid.tags.bodies.oval import rounded
from tagid.tags.bodies.spectra import Spectra, centred

APART_M = 3e-3
"""Minima of the body's fit nearer than this are one."""

_FINEST_M = 1e-4


@dataclass(frozen=True)
class RoundBody:
    """A body of revolution of unknown centre (a `BodyModel`).

    Attributes:
        reach_m: its centre is searched up to so far from the rotation axis, m.
        step_m: of the search, m; a quarter of the shortest wavelength is 16 mm.
        starts: poses returned at most.
    """

    reach_m: float = 0.014
    step_m: float = 2e-3
    starts: int = 2

    @property
    def name(self) -> str:
        """A body of revolution is not enrolled."""
        return ""

    @property
    def turns(self) -> bool:
        """It looks the same from all sides."""
        return False

    @property
    def turning_share(self) -> float:
        """Nothing of its echo depends on its turn."""
        return 0.0

    @property
    def slack_m(self) -> float:
        """The reflectors are placed about its own centre."""
        return 0.0

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """(H, F, V) exp(-j kappa (rho_v - d)) (d / rho_v)^2, rho_v from the centre to the antenna's foot.

        In the plane: an upright wall returns from the antenna's own height.
        """
        rho = np.abs(spectra.antenna - np.asarray(centres)[:, None])
        waves = spectra.waves(rho) * (spectra.distance_m / rho) ** 2
        return np.ascontiguousarray(np.moveaxis(waves, 0, 1))

    def seen(
        self,
        spectra: Spectra,
        pose: Pose,
        beside: NDArray[np.complex128] | None = None,
        variance: float = 0.0,
    ) -> Seen | None:
        """Its centre, and the scans as if it were round; None where nothing shows that it is not (`oval`)."""
        return rounded(spectra, pose, beside, variance)

    def poses(self, spectra: Spectra) -> list[Candidate]:
        """The best minima over the centre: a grid, then parabolic steps on both axes."""
        count = int(np.ceil(self.reach_m / self.step_m))
        line = np.arange(-count, count + 1) * self.step_m
        grid = (line[:, None] + 1j * line[None]).ravel()
        grid = grid[np.abs(grid) <= self.reach_m]
        left = self._left(spectra, grid)
        found: list[Candidate] = []
        for i in np.argsort(left):
            if all(abs(grid[i] - one.pose.centre) > 2.5 * self.step_m for one in found):
                found.append(Candidate(Pose((grid[i].real, grid[i].imag)), float(left[i])))
            if len(found) == self.starts:
                break
        return sorted((self._refined(spectra, one) for one in found), key=lambda one: one.left)

    def middle(self, spectra: Spectra, echo: NDArray[np.complex128], near: complex) -> Candidate:
        """The centre about which the whole echo (F, V) of another body is most that of a round one.

        With what does not change over the views, so that it holds for a body on the rotation axis, too.

        Args:
            spectra: the scans.
            echo: of that body in its pose, with what is constant over the views.
            near: where the search begins, m.

        Returns:
            The centre, and the share of the echo's energy that a round body there leaves.
        """
        energy = max(float((np.abs(echo) ** 2).sum()), 1e-300)

        def left(centres: NDArray[np.complex128]) -> NDArray[np.float64]:
            column = self.echo(spectra, centres, np.zeros(len(centres)))
            along = np.abs((column.conj() * echo).sum(axis=-1)) ** 2
            return np.asarray(1 - (along / (np.abs(column) ** 2).sum(axis=-1)).sum(axis=-1) / energy)

        centre, step = near, 2 * self.step_m
        star = np.array([0, 1, -1, 1j, -1j], dtype=np.complex128)
        while step > _FINEST_M:
            value = left(centre + step * star)
            best = int(np.argmin(value))
            centre = complex(centre + step * star[best])
            step = step if best else step / 2
        return Candidate(Pose((centre.real, centre.imag)), float(left(np.array([centre]))[0]))

    def _refined(self, spectra: Spectra, start: Candidate) -> Candidate:
        centre, step, left = start.pose.centre, self.step_m / 2, start.left
        star = np.array([0, 1, -1, 1j, -1j], dtype=np.complex128)
        for _ in range(7):
            value = self._left(spectra, np.asarray(centre + step * star))
            move = [_vertex(value[0], value[1], value[2]), _vertex(value[0], value[3], value[4])]
            trial = centre + step * complex(*move)
            trials = np.asarray(np.append(centre + step * star, trial), dtype=np.complex128)
            values = np.append(value, self._left(spectra, trials[-1:]))
            best = int(np.argmin(values))
            centre, left = complex(trials[best]), float(values[best])
            step *= 0.4
        return Candidate(Pose((centre.real, centre.imag)), left)

    def _left(self, spectra: Spectra, centres: NDArray[np.complex128]) -> NDArray[np.float64]:
        """(H,) energy left by the body alone."""
        column = centred(self.echo(spectra, centres, np.zeros(len(centres))))
        along = np.abs((column.conj() * spectra.data).sum(axis=-1)) ** 2
        size = (column.real**2 + column.imag**2).sum(axis=-1)
        # A body on the axis does not move: its column vanishes, and it explains nothing.
        floor = 1e-9 * spectra.views
        return np.asarray(spectra.energy - (along / np.maximum(size, floor)).sum(axis=-1))


def _vertex(middle: float, ahead: float, behind: float) -> float:
    """Where the parabola through three values at 0, 1, -1 is least, within -1..1."""
    bend = ahead + behind - 2 * middle
    if bend <= 0:
        return float(np.sign(behind - ahead))
    return float(np.clip((behind - ahead) / (2 * bend), -1, 1))
