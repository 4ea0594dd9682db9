"""Triangle meshes of thin surfaces, and the RWG basis functions on them.

A mesh is an open or closed surface of zero thickness. Metal is a perfect conductor; a thin dielectric sheet
is described by one number, (permittivity - 1) * thickness.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError

MAX_TRIANGLES = 6000
"""About 9000 unknowns: the dense matrix then takes 1.3 GB."""

_MERGE_M = 1e-7
"""Vertices that are closer than this are one vertex."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles.

    Triangles are connected if they share an edge, that is, two vertices; a shared vertex alone carries no
    current. An edge may belong to more than two triangles (plates that cross or meet).

    Attributes:
        vertices: (n, 3) float64, m.
        triangles: (t, 3) int64, indices of the vertices.
        sheet_m: (t,) complex128, (relative permittivity - 1) * thickness of a dielectric sheet, m; a negative
            imaginary part is loss (time convention exp(+j omega t)). 0 is metal.

    Raises DataError: wrong shapes, indices out of range, values that are not finite, a triangle without area.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    sheet_m: NDArray[np.complex128]

    def __post_init__(self) -> None:
        v, t = self.vertices, self.triangles
        if v.ndim != 2 or v.shape[1] != 3 or not np.isfinite(v).all():
            raise DataError(f"mesh vertices have shape {v.shape}, expected (n, 3), finite")
        if t.ndim != 2 or t.shape[1] != 3 or len(t) == 0:
            raise DataError(f"mesh triangles have shape {t.shape}, expected (t, 3)")
        if len(t) > MAX_TRIANGLES:
            raise DataError(
                f"the mesh has {len(t)} triangles, more than {MAX_TRIANGLES}", "Use longer mesh edges."
            )
        if t.min() < 0 or t.max() >= len(v):
            raise DataError(f"mesh triangles name vertex {t.max()}, but there are {len(v)}")
        if self.sheet_m.shape != (len(t),) or not np.isfinite(self.sheet_m).all():
            raise DataError(f"mesh sheet_m has shape {self.sheet_m.shape}, expected ({len(t)},), finite")
        if (self.areas_m2 < 1e-12).any():
            raise DataError(f"mesh triangle {int(np.argmin(self.areas_m2))} has no area")

    @classmethod
    def of(
        cls, vertices: NDArray[np.floating], triangles: NDArray[np.integer], sheet_m: complex = 0.0
    ) -> Mesh:
        """A mesh of one material, with coinciding vertices merged and collapsed triangles removed."""
        # The offset keeps round numbers, frequent in these shapes, away from the rounding boundary.
        key = np.round(np.asarray(vertices, np.float64) / _MERGE_M + 0.137).astype(np.int64)
        _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
        t = index.reshape(-1)[np.asarray(triangles)]
        whole = (t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])
        t = t[whole].astype(np.int64)
        return cls(np.asarray(vertices, np.float64)[first], t, np.full(len(t), sheet_m, np.complex128))

    @classmethod
    def join(cls, *meshes: Mesh) -> Mesh:
        """All meshes as one; they are connected if edges coincide."""
        start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        triangles = np.concatenate([m.triangles + s for m, s in zip(meshes, start[:-1], strict=True)])
        joined = cls.of(vertices, triangles)
        if len(joined.triangles) != len(triangles):
            raise DataError("a triangle collapses when the meshes are joined", "Use longer mesh edges.")
        return cls(joined.vertices, joined.triangles, np.concatenate([m.sheet_m for m in meshes]))

    def moved(self, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0), turn_rad: float = 0.0) -> Mesh:
        """The mesh rotated about the z axis, counter-clockwise from above, then shifted."""
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return Mesh(self.vertices @ turn + np.asarray(shift_m), self.triangles, self.sheet_m)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """(t, 3, 3) corners of every triangle, m."""
        return self.vertices[self.triangles]

    @cached_property
    def areas_m2(self) -> NDArray[np.float64]:
        """(t,) areas, m^2."""
        p = self.corners
        return np.asarray(0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1))

    @cached_property
    def longest_edge_m(self) -> float:
        """The longest edge, m, which limits the shortest wavelength."""
        p = self.corners
        return float(np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).max())


@dataclass(frozen=True, eq=False)
class HalfFunction:
    """The two halves of RWG functions, and how functions are composed of them.

    The half (t, i) is defined on triangle t with outflow through edge i, opposite corner i:
    h_ti(r) = c_ti (r - v_ti), div h_ti = 2 c_ti, with c_ti = edge length / (2 area). Its normal component
    is 1 along that edge and 0 along the other two (Rao, Wilton, Glisson, IEEE Trans. Antennas Propag. 30,
    409, 1982).

    Attributes:
        scale: (t, 3) c_ti, 1/m.
        plus, minus: (functions,) index 3 t + i of the half with sign +1 and of the half with sign -1.
    """

    scale: NDArray[np.float64]
    plus: NDArray[np.int64]
    minus: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: Mesh) -> HalfFunction:
        """The functions of a mesh.

        An edge with n triangles carries n - 1 functions: the first triangle is paired with each of the
        others. They span every current whose sum over the edge is zero, which is Kirchhoff's law at a
        junction.

        Raises DataError if no edge is shared, so that no current can flow.
        """
        p = mesh.corners
        ends = np.stack([np.roll(mesh.triangles, -1, axis=1), np.roll(mesh.triangles, -2, axis=1)], axis=2)
        length = np.linalg.norm(np.roll(p, -1, axis=1) - np.roll(p, -2, axis=1), axis=2)
        edge = np.sort(ends.reshape(-1, 2), axis=1)
        order = np.lexsort((edge[:, 1], edge[:, 0]))
        edge = edge[order]
        begins = np.concatenate([[True], (edge[1:] != edge[:-1]).any(axis=1)])
        first = order[np.maximum.accumulate(np.where(begins, np.arange(len(order)), 0))]
        if begins.all():
            raise DataError("no two triangles of the mesh share an edge, so no current can flow")
        return cls(length / (2 * mesh.areas_m2[:, None]), first[~begins], order[~begins])
