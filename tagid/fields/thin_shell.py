"""The field at and next to thin shells: a helmet's, about an ellipse from above, and the walls of a carton.

An infinite upright cylinder, of elliptic or rectangular cross section, carries a sheet whose thickness d is
far below the wavelength. For upright polarisation the electric field E is axial, and the sheet's polarisation
current radiates as a line source at every point s of the contour (time convention exp(+j omega t)):

    E(r) = E0(r) + k^2 (eps - 1) d  integral G(|r - s|) E(s) ds,   G(x) = H_0^(2)(k x) / (4 j).

On the contour this is a linear system, solved by collocation in steps of a twelfth of the wavelength; the
field at another point follows from it. By reciprocity a small reflector at r returns E(r)^2, and the
shell itself the integral of E0 E ds. Source: Richmond, Scattering by a dielectric cylinder of arbitrary
cross section shape, IEEE Transactions on Antennas and Propagation 13(3), 1965, for a body that is one cell
thick.

Amplitudes of a cylinder are not those of a half ellipsoid. With one free amplitude per frequency it leaves
1 to 3 % of the echo of solved helmet shells, and 2.5 to 5 % of that of the reflectors on them; of solved
cartons 0.6 to 0.8 %, and 0.5 to 2 % of that of reflectors in them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.fields.bessel import bessel

POINTS = 108
"""Points of the contour: 5 mm of a helmet's, a twelfth of the shortest wavelength."""
_FROM, _TO, _STEP = 0.02, 60.0, 0.004
"""Arguments of the table of Hankel's function, between which it is interpolated: to 1e-4 from 0.2 on."""


@dataclass(frozen=True)
class ThinShell(ABC):
    """A thin shell.

    Attributes:
        across_m, along_m: half the size of the contour along its own x and y, m.
        sheet_m: (eps - 1) d, m: 5.4 mm of plastic 3 mm thick. A shell that ends above and below acts as half
            of that.
    """

    across_m: float
    along_m: float
    sheet_m: float

    def __post_init__(self) -> None:
        if not (0.01 <= self.across_m <= 1.0 and 0.01 <= self.along_m <= 1.0 and 0 < self.sheet_m <= 10.0):
            raise DataError(f"a shell has half axes of {self.across_m} and {self.along_m} m")

    @property
    @abstractmethod
    def radius_m(self) -> float:
        """Largest distance of the contour from its centre, m."""

    @abstractmethod
    def outline(self, points: int) -> Outline:
        """The contour in about so many cells, anticlockwise from the positive x axis.

        Their number is a multiple of four, and those of a quadrant mirror those of the next.
        """

    @abstractmethod
    def outside_m(self, positions: NDArray[np.complex128]) -> NDArray[np.float64]:
        """(...) distance of places x + jy (...) outside the contour, m; negative inside.

        Of an ellipse it is that along the ray from its centre.
        """


@dataclass(frozen=True)
class EllipticShell(ThinShell):
    """A thin elliptic shell, as that of a helmet."""

    @property
    def radius_m(self) -> float:
        """The longer half axis."""
        return max(self.across_m, self.along_m)

    def outline(self, points: int) -> Outline:
        """Cells of equal eccentric anomaly."""
        points = 4 * max(round(points / 4), 1)
        turn = 2 * np.pi * (np.arange(points) + 0.5) / points
        a, b = self.across_m, self.along_m
        contour = a * np.cos(turn) + 1j * b * np.sin(turn)
        step = np.hypot(a * np.sin(turn), b * np.cos(turn)) * 2 * np.pi / points
        normal = contour.real / a**2 + 1j * contour.imag / b**2
        return Outline(contour, step, np.asarray(normal / np.abs(normal)))

    def outside_m(self, positions: NDArray[np.complex128]) -> NDArray[np.float64]:
        """See `ThinShell`."""
        direction = np.angle(positions)
        wall = (
            self.across_m
            * self.along_m
            / np.hypot(self.along_m * np.cos(direction), self.across_m * np.sin(direction))
        )
        return np.asarray(np.abs(positions) - wall)


@dataclass(frozen=True)
class BoxShell(ThinShell):
    """Four thin upright walls, as those of a carton or a crate."""

    @property
    def radius_m(self) -> float:
        """Half the diagonal."""
        return float(np.hypot(self.across_m, self.along_m))

    def outline(self, points: int) -> Outline:
        """As many cells on every wall, so that sizes change no cell's place along it."""
        half = max(round(points / 8), 1)
        cells = 2 * half
        along = (2 * np.arange(cells) + 1 - cells) / cells
        a, b, ones = self.across_m, self.along_m, np.ones(cells)
        contour = np.concatenate(
            [a + 1j * b * along, -a * along + 1j * b, -a - 1j * b * along, a * along - 1j * b]
        )
        step = np.concatenate([b * ones, a * ones, b * ones, a * ones]) * 2 / cells
        normal = np.concatenate([ones + 0j, 1j * ones, -ones + 0j, -1j * ones])
        # From the corner to the middle of the first wall.
        return Outline(np.roll(contour, -half), np.roll(step, -half), np.roll(normal, -half))

    def outside_m(self, positions: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Distance beyond the plane of the nearest wall."""
        return np.asarray(
            np.maximum(np.abs(positions.real) - self.across_m, np.abs(positions.imag) - self.along_m)
        )


@dataclass(frozen=True, eq=False)
class Outline:
    """A contour in N cells.

    Attributes:
        contour: (N,) their middles x + jy, m.
        step_m: (N,) their lengths, m.
        normal: (N,) outward, unit length.
    """

    contour: NDArray[np.complex128]
    step_m: NDArray[np.float64]
    normal: NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class ShellField:
    """The solved field of a shell.

    Attributes:
        wavenumber: (F,) in free space, rad/m.
        inverse: (4, F, N / 4, N / 4) from the incident field on the contour to the whole one. What is even or
            odd about either axis couples with itself only: four systems of a quarter of the size.
    """

    wavenumber: NDArray[np.float64]
    shell: ThinShell
    outline: Outline
    inverse: NDArray[np.complex128]

    @classmethod
    def of(cls, wavenumber: NDArray[np.float64], shell: ThinShell, points: int = POINTS) -> ShellField:
        """The field at wavenumbers (F,), rad/m."""
        outline = shell.outline(points)
        contour, step = outline.contour, outline.step_m
        images = _images(len(contour))
        quadrant = images[0]
        apart = np.abs(contour[quadrant, None] - contour)
        apart[quadrant, quadrant] = 1.0
        k = wavenumber[:, None, None]
        coupling = _line_source(k * apart) * step
        # The mean of Hankel's function over a cell about its singularity, by its leading terms.
        diagonal = (1 - 2j / np.pi * (np.log(k[:, 0] * step[quadrant] / 4) + np.euler_gamma - 1)) / 4j
        coupling[:, quadrant, quadrant] = diagonal * step[quadrant]
        rows = np.eye(len(quadrant), len(contour)) - k**2 * shell.sheet_m * coupling
        blocks = _even_odd(np.stack([rows[:, :, image] for image in images]))
        return cls(wavenumber, shell, outline, np.asarray(np.linalg.inv(blocks)))

    def echo(self, antenna: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(F, V) echo of the shell alone to antennas x + jy (V,), m, in any common unit per frequency."""
        return self.seen_from(antenna).echoes(1)[:, 0]

    def reach(self, positions: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(F, K, N) from the whole field on the contour to what the shell adds at places x + jy (K,), m."""
        k = self.wavenumber[:, None, None]
        apart = np.abs(positions[:, None] - self.outline.contour)
        return np.asarray(k**2 * self.shell.sheet_m * _line_source(k * apart) * self.outline.step_m)

    def whole(self, incident: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(F, N, V) the whole field on the contour from the incident one (F, N, V), whatever its source."""
        images = _images(len(self.outline.contour))
        parts = _even_odd(np.stack([incident[:, image] for image in images]))
        answers = _even_odd(self.inverse @ parts)
        out = np.empty_like(incident)
        for image, answer in zip(images, answers, strict=True):
            out[:, image] = answer / 4
        return out

    def seen_from(self, antenna: NDArray[np.complex128]) -> ShellView:
        """The field that antennas x + jy (V,), m, make."""
        range_m = np.abs(self.outline.contour[:, None] - antenna)
        incident = _waves(self.wavenumber, range_m) / range_m
        return ShellView(self, antenna, incident, self.whole(incident))


def _images(cells: int) -> NDArray[np.intp]:
    """(4, N / 4) the first quadrant's cells, those mirrored left, down, and both."""
    first = np.arange(cells // 4)
    return np.stack([first, cells // 2 - 1 - first, cells - 1 - first, cells // 2 + first])


def _even_odd(parts: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """(4, ...) parts that are even or odd about each axis, from values (4, ...) of a quadrant and its images.

    It is its own inverse but for a factor of 4.
    """
    even_left, even_right = parts[0] + parts[1], parts[2] + parts[3]
    odd_left, odd_right = parts[0] - parts[1], parts[2] - parts[3]
    return np.stack(
        [even_left + even_right, odd_left + odd_right, even_left - even_right, odd_left - odd_right]
    )


@dataclass(frozen=True, eq=False)
class ShellView:
    """The field of a shell from some antennas, relative to that at 1 m, spherical, without the shell.

    Attributes:
        antenna: (V,) x + jy, m.
        incident, whole: (F, N, V) field on the contour, without the shell and with it.
    """

    field: ShellField
    antenna: NDArray[np.complex128]
    incident: NDArray[np.complex128]
    whole: NDArray[np.complex128]

    def echoes(self, obliquities: int) -> NDArray[np.complex128]:
        """(F, P, V) echoes of the shell weighted by powers of the cosine of incidence, from 0 to P - 1.

        A half ellipsoid curves upwards, too, and what it returns at grazing incidence is not what a cylinder
        does. With an amplitude for each of three powers, solved shells leave 0.04 to 0.6 % of their echo.
        """
        outline = self.field.outline
        toward = self.antenna - outline.contour[:, None]
        cosine = (toward * outline.normal.conj()[:, None]).real / np.abs(toward)
        powers = cosine ** np.arange(obliquities)[:, None, None] * outline.step_m[:, None]
        return np.asarray(np.einsum("fnv,pnv->fpv", self.whole * self.incident, powers, optimize=True))

    def relative(self, positions: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(F, K, V) echo of small reflectors at places x + jy (K,), m, over that without the shell."""
        field = self.field
        added = field.reach(positions) @ self.whole
        range_m = np.abs(self.antenna - positions[:, None])
        return np.asarray((1 + added * range_m * _waves(field.wavenumber, range_m).conj()) ** 2)


def _waves(wavenumber: NDArray[np.float64], path_m: NDArray[np.float64]) -> NDArray[np.complex128]:
    """(F, ...) exp(-j k path) of paths (...), m, by products where wavenumbers (F,) are equally spaced."""
    steps = np.diff(wavenumber)
    if len(steps) < 2 or np.ptp(steps) > 1e-9 * wavenumber[-1]:
        return np.asarray(np.exp(-1j * np.multiply.outer(wavenumber, path_m)))
    out = np.empty((len(wavenumber), *path_m.shape), dtype=np.complex128)
    out[0] = np.exp(-1j * wavenumber[0] * path_m)
    turn = np.exp(-1j * steps.mean() * path_m)
    for i in range(1, len(out)):
        np.multiply(out[i - 1], turn, out=out[i])
    return out


@cache
def line_source_table() -> tuple[NDArray[np.complex128], float, float]:
    """G of the module's formula at equally spaced arguments, the first of them, and their step."""
    values = bessel(0, np.arange(_FROM, _TO, _STEP))
    return np.ascontiguousarray((values.j[:, 0] - 1j * values.y[:, 0]) / 4j), _FROM, _STEP


@cache
def _table() -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """G at equally spaced arguments from _FROM on, and how much more it is at the next."""
    table = line_source_table()[0]
    return table[:-1], np.diff(table)


def _line_source(x: NDArray[np.float64]) -> NDArray[np.complex128]:
    """G of the module's formula at k |r - s|, its singularity cut off."""
    table, slopes = _table()
    at = np.clip((x - _FROM) / _STEP, 0, len(table) - 1)
    low = at.astype(np.intp)
    return np.asarray(table.take(low) + (at - low) * slopes.take(low))
