"""The electric field integral equation on a mesh: matrix, excitation, and monostatic echo.

Galerkin's method with RWG functions f_m (Rao, Wilton, Glisson, IEEE Trans. Antennas Propag. 30, 409, 1982):

    A_mn = int int (f_m . f_n - div f_m div f_n / k^2) exp(-jkR) / R dS' dS
    S = -V^T A^-1 V,    V_m = int f_m . E dS

for time convention exp(+j omega t). E is the incident field of a Hertzian dipole at the antenna, scaled so
that far away E = p exp(-jkR) / R for its polarisation p. By reciprocity S is the component along p, at the
antenna, of the scattered field (impedance matrix Z = j omega mu / (4 pi) A; a dipole of that scale has the
moment I l = -4 pi / (j omega mu)).

A dielectric sheet of thickness t much thinner than the wavelength carries a polarisation current that is
tangential and constant across it: E_incident + E_scattered = J / (j omega eps0 (eps - 1) t) (Harrington,
Mautz, IEEE Trans. Antennas Propag. 23, 531, 1975). Hence A_mn - 4 pi / (k^2 (eps - 1) t) int f_m . f_n dS.

Limits. A mesh edge should be at most 1/7 of the wavelength: 8 mm at 5 GHz, about 100 unknowns per square
wavelength. Closed metal surfaces fail near their interior resonances (the field inside is not excited, but
the matrix is nearly singular); open cans, boxes and crossing plates have no such frequencies. The sheet
model neglects the current across the sheet, and holds while k t sqrt(eps) is below about 0.5.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial import cKDTree

from tagid.errors import DataError
from tagid.types import Floats
from train.fullwave.mesh import HalfFunction, Mesh
from train.fullwave.singular import RULE_3, RULE_7, static_potentials

Complexes = NDArray[np.complex128]

_BLOCK = 96
"""Number of triangles for which the far interactions are computed at once."""

_REACH = 2.0
"""Triangles are a near pair if their centres are closer than this times the sum of their radii."""


@dataclass(frozen=True, eq=False)
class _Near:
    """Pairs (n,) of triangles p <= q near each other, with the part of their interaction independent of k:
    (functions, functions) int int f_m . f_n / R and int int div f_m div f_n / R."""

    p: NDArray[np.int64]
    q: NDArray[np.int64]
    vector: sparse.csr_array
    scalar: sparse.csr_array


@dataclass(frozen=True, eq=False)
class _FarBlock:
    """The distances from a block of triangles to itself and to all later triangles.

    Attributes:
        begin, end: the block's triangles.
        distance: (3 (all - begin), 3 (end - begin)) between their points, m.
        row, col: (n,) near pairs to omit, as triangles after `begin`; row is in the block.
    """

    begin: int
    end: int
    distance: Floats
    row: NDArray[np.int64]
    col: NDArray[np.int64]


class Efie:
    """The integral equation of one mesh at any frequency; parts independent of frequency are computed once.

    Raises DataError if no current can flow on the mesh.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.halves = half = HalfFunction.of(mesh)
        t, n = len(mesh.triangles), len(half.plus)
        column = np.arange(n)
        signs = np.concatenate([np.ones(n), -np.ones(n)])
        # (halves, functions): f_n = sum over halves.
        self._compose = sparse.csr_array(
            (signs, (np.concatenate([half.plus, half.minus]), np.concatenate([column, column]))), (3 * t, n)
        )
        bary, weight = RULE_3
        self.points: Floats = np.einsum("qi,tic->tqc", bary, mesh.corners).reshape(-1, 3)
        # Functions sampled at the points, times the points' weights: x, y, z and the divergence.
        arm = np.einsum("qi,tic->tqc", bary, mesh.corners)[:, :, None] - mesh.corners[:, None]
        area = weight[None, :, None] * mesh.areas_m2[:, None, None] * half.scale[:, None, :]
        row = np.repeat(np.arange(3 * t), 3)
        local = (
            3 * np.arange(t)[:, None, None] + np.arange(3)[None, None] + np.zeros((1, 3, 1), int)
        ).ravel()
        parts = [*(area * arm[..., c] for c in range(3)), 2 * area]
        self._sampled = [
            (sparse.csr_array((part.ravel(), (row, local)), (3 * t, 3 * t)) @ self._compose).tocsr()
            for part in parts
        ]
        self._near = self._near_pairs()
        self._blocks = list(self._far_distances())
        self._gram = self._sheet_gram()

    @property
    def unknowns(self) -> int:
        """Number of basis functions."""
        return len(self.halves.plus)

    def _functions_of(
        self, local: Complexes | Floats, p: NDArray[np.int64], q: NDArray[np.int64]
    ) -> sparse.csr_array:
        """(functions, functions) from interactions (n, 3, 3) of the halves of triangles p and q."""
        t = len(self.mesh.triangles)
        row = (3 * p[:, None, None] + np.arange(3)[None, :, None] + np.zeros((1, 1, 3), int)).ravel()
        col = (3 * q[:, None, None] + np.arange(3)[None, None, :] + np.zeros((1, 3, 1), int)).ravel()
        halves = sparse.csr_array((local.ravel(), (row, col)), (3 * t, 3 * t))
        functions: sparse.csr_array = (self._compose.T @ halves @ self._compose).tocsr()
        return functions

    def _near_pairs(self) -> _Near:
        """Pairs and their static interaction: 1/R in closed form inside, seven points outside."""
        mesh, scale = self.mesh, self.halves.scale
        centre = mesh.corners.mean(axis=1)
        radius = np.linalg.norm(mesh.corners - centre[:, None], axis=2).max(axis=1)
        pairs = cKDTree(centre).query_pairs(2 * _REACH * radius.max(), output_type="ndarray")
        apart = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1)
        pairs = pairs[apart < _REACH * (radius[pairs[:, 0]] + radius[pairs[:, 1]])]
        itself = np.arange(len(centre))
        p = np.concatenate([itself, pairs[:, 0]]).astype(np.int64)
        q = np.concatenate([itself, pairs[:, 1]]).astype(np.int64)
        bary, weight = RULE_7
        shape = (self.unknowns, self.unknowns)
        vector, scalar = sparse.csr_array(shape), sparse.csr_array(shape)
        # Both orders of integration, and their mean: the exact matrix is symmetric.
        for outer, inner in ((p, q), (q, p)):
            for part in np.array_split(np.arange(len(p)), 1 + len(p) // 20_000):
                a, b = outer[part], inner[part]
                r = np.einsum("qi,tic->tqc", bary, mesh.corners[a])
                potential, moment = static_potentials(r, mesh.corners[b])
                # The self pair is identical in both orders, so each counts half.
                w = weight * (mesh.areas_m2[a] * np.where(a == b, 0.5, 1.0))[:, None]
                c = scale[a][:, :, None] * scale[b][:, None, :]
                out = r[:, :, None] - mesh.corners[a][:, None]
                inside = moment[:, :, None] - potential[..., None, None] * mesh.corners[b][:, None]
                both = c * np.einsum("nq,nqic,nqjc->nij", w, out, inside, optimize=True)
                charge = 4 * c * np.einsum("nq,nq->n", w, potential)[:, None, None]
                vector = vector + self._functions_of(both, a, b)
                scalar = scalar + self._functions_of(charge, a, b)
        vector, scalar = 0.5 * (vector + vector.T), 0.5 * (scalar + scalar.T)
        return _Near(p, q, vector.tocsr(), scalar.tocsr())

    def _far_distances(self) -> Iterator[_FarBlock]:
        """The upper block triangle of the distances; the matrix is symmetric."""
        t = len(self.mesh.triangles)
        p, q = np.minimum(self._near.p, self._near.q), np.maximum(self._near.p, self._near.q)
        order = np.argsort(p, kind="stable")
        p, q = p[order], q[order]
        for begin in range(0, t, _BLOCK):
            end = min(t, begin + _BLOCK)
            here = slice(*np.searchsorted(p, [begin, end]))
            left, right = self.points[3 * begin : 3 * end], self.points[3 * begin :]
            square = (right**2).sum(1)[:, None] + (left**2).sum(1)[None] - 2 * right @ left.T
            distance = np.sqrt(np.maximum(square, 1e-12))
            row, col = p[here] - begin, q[here] - begin
            inside = col < end - begin  # the diagonal block is full, so it holds these pairs twice
            yield _FarBlock(begin, end, distance, np.append(row, col[inside]), np.append(col, row[inside]))

    def _sheet_gram(self) -> sparse.csr_array | None:
        """int f_m . f_n / ((eps - 1) t) dS over the dielectric sheets; None if all is metal."""
        mesh, scale = self.mesh, self.halves.scale
        sheets = np.flatnonzero(mesh.sheet_m != 0).astype(np.int64)
        if not len(sheets):
            return None
        bary, weight = RULE_3  # exact: the integrand is of degree two
        r = np.einsum("qi,tic->tqc", bary, mesh.corners[sheets])
        arm = r[:, :, None] - mesh.corners[sheets][:, None]
        gram = np.einsum("q,tqic,tqjc->tij", weight, arm, arm, optimize=True)
        factor = scale[sheets][:, :, None] * scale[sheets][:, None, :]
        gram = (
            gram
            * factor
            * (mesh.areas_m2 / np.where(mesh.sheet_m == 0, 1, mesh.sheet_m))[sheets][:, None, None]
        )
        return self._functions_of(gram, sheets, sheets)

    def _near_remainder(self, k: float) -> sparse.csr_array:
        """The smooth part (exp(-jkR) - 1) / R of the near pairs, seven by seven points."""
        mesh, scale, near = self.mesh, self.halves.scale, self._near
        bary, weight = RULE_7
        r = np.einsum("qi,tic->tqc", bary, mesh.corners)
        w = weight * mesh.areas_m2[:, None]
        arm = (r[:, :, None] - mesh.corners[:, None]) * w[:, :, None, None]
        total = sparse.csr_array((self.unknowns, self.unknowns), dtype=np.complex128)
        for part in np.array_split(np.arange(len(near.p)), 1 + len(near.p) // 20_000):
            p, q = near.p[part], near.q[part]
            distance = np.sqrt(((r[p][:, :, None] - r[q][:, None]) ** 2).sum(axis=3))
            phase, safe = k * distance, np.maximum(distance, 1e-9)
            kernel = np.empty(distance.shape, dtype=np.complex128)
            # 1 - cos as 2 sin^2 does not cancel at small distances; at R = 0 the limit is -jk.
            kernel.real = -2 * np.sin(phase / 2) ** 2 / safe
            kernel.imag = np.where(distance > 1e-9, -np.sin(phase) / safe, -k)
            c = scale[p][:, :, None] * scale[q][:, None, :]
            local = -4 / k**2 * np.einsum("na,nab,nb->n", w[p], kernel, w[q], optimize=True)[
                :, None, None
            ] + sum(
                np.matmul(np.matmul(arm[p][..., x].transpose(0, 2, 1), kernel), arm[q][..., x])
                for x in range(3)
            )
            # The transpose is added at the end; the self pair is its own transpose.
            local = local * c * np.where(p == q, 0.5, 1.0)[:, None, None]
            total = total + self._functions_of(local, p, q)
        return (total + total.T).tocsr()

    def matrix(self, k: float) -> Complexes:
        """A (functions, functions) in m^3 for the wavenumber k, 1/m; symmetric, not Hermitian."""
        n = self.unknowns
        upper = np.zeros((n, n), dtype=np.complex128)
        for block in self._blocks:
            begin, end = block.begin, block.end
            kernel = np.empty(block.distance.shape, dtype=np.complex128)
            phase = k * block.distance
            np.cos(phase, out=kernel.real)
            np.sin(phase, out=kernel.imag)
            np.negative(kernel.imag, out=kernel.imag)
            kernel /= block.distance
            width = end - begin
            kernel.reshape(-1, 3, width, 3)[block.col, :, block.row, :] = 0.0
            kernel[: 3 * width] *= 0.5  # the diagonal block is full already, and the transpose is added below
            flat = kernel.view(np.float64)
            for part, factor in zip(self._sampled, (1.0, 1.0, 1.0, -1 / k**2), strict=True):
                sampled = part[3 * begin : 3 * end]
                used = np.unique(sampled.indices)
                # (functions, points of the block)
                right = (part[3 * begin :].T.tocsr() @ flat).view(np.complex128)
                upper[:, used] += factor * (right @ sampled[:, used])
        upper += upper.T
        near = self._near.vector - self._near.scalar / k**2 + self._near_remainder(k)
        if self._gram is not None:
            near = near - 4 * np.pi / k**2 * self._gram
        near = near.tocoo()
        upper[near.row, near.col] += near.data
        return upper

    def excitation(self, k: float, antennas: Floats, polarisation: Floats) -> Complexes:
        """V (functions, antennas) in m: the incident field of dipoles, tested with every function.

        Args:
            k: wavenumber, 1/m.
            antennas: (n, 3), m.
            polarisation: (n, 3) unit vectors.

        Raises DataError if an antenna touches the mesh.
        """
        total = np.zeros((self.unknowns, len(antennas)), dtype=np.complex128)
        tested = [part.T.tocsr() for part in self._sampled[:3]]
        for chunk in np.array_split(np.arange(len(antennas)), 1 + len(antennas) // 64):
            field = dipole_field(k, self.points, antennas[chunk], polarisation[chunk])
            for c in range(3):
                total[:, chunk] += tested[c] @ field[c]
        return total

    def currents(self, k: float, excitation: Complexes) -> Complexes:
        """A^-1 V (functions, antennas), 1/m^2: the current that each excitation drives, up to a factor."""
        factors = lu_factor(self.matrix(k), overwrite_a=True, check_finite=False)
        return np.asarray(lu_solve(factors, excitation, check_finite=False))

    def monostatic(self, k: float, antennas: Floats, polarisation: Floats) -> Complexes:
        """S (antennas,) in 1/m: the scattered field at each antenna, along its own polarisation."""
        v = self.excitation(k, antennas, polarisation)
        return np.asarray(-(v * self.currents(k, v)).sum(axis=0))


def dipole_field(k: float, points: Floats, antennas: Floats, polarisation: Floats) -> Complexes:
    """Field E (3, points, antennas) of Hertzian dipoles, p exp(-jkR) / R far away across the line of sight.

    E = exp(-jkR) / R [p (1 + q) - R^ (R^ . p) (1 + 3 q)], q = -j / (kR) - 1 / (kR)^2 (Balanis, Antenna
    Theory, 4th edition, section 4.2).

    Raises DataError if a point is within 1 mm of an antenna.
    """
    sight = points[:, None] - antennas
    distance = np.linalg.norm(sight, axis=2)
    if distance.min(initial=np.inf) < 1e-3:
        raise DataError("an antenna touches the object", "Move the antenna away from the mesh.")
    sight /= distance[..., None]
    along = np.einsum("pac,ac->pa", sight, polarisation)
    kr = k * distance
    q = -1j / kr - 1 / kr**2
    wave = np.exp(-1j * kr) / distance
    direct, radial = wave * (1 + q), wave * along * (1 + 3 * q)
    return np.stack([polarisation[:, c] * direct - sight[..., c] * radial for c in range(3)])
