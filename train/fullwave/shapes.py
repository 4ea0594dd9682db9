"""Meshes of the solved objects: reflectors, cans, cups, handles, helmets, boxes, and test bodies.

Lengths are in metres. The z axis is the object's upright axis, and z = 0 the plane of its tag. `edge_m` is
the target length of a mesh edge; 8 mm is 1/7.5 of the wavelength at 5 GHz.
"""

from __future__ import annotations

import itertools
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.types import Floats
from train.fullwave.mesh import Mesh


def sheet(permittivity: complex, thickness_m: float) -> complex:
    """`Mesh.sheet_m` of a dielectric sheet: (relative permittivity - 1) * thickness, m."""
    if not (np.isfinite(permittivity) and complex(permittivity).real > 1 and 0 < thickness_m < 0.05):
        raise DataError(f"a sheet of permittivity {permittivity} and {thickness_m} m cannot be meshed")
    return (complex(permittivity) - 1) * thickness_m


def _cut(a: Floats, b: Floats, c: Floats, pieces: int) -> Mesh:
    """Triangle a b c, divided into pieces^2 similar triangles."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij"))
    vertices = a + np.outer(i / pieces, b - a) + np.outer(j / pieces, c - a)

    def at(row: NDArray[np.integer], column: NDArray[np.integer]) -> NDArray[np.integer]:
        return row * (pieces + 1) + column

    up, down = i + j < pieces, (i > 0) & (j > 0) & (i + j <= pieces)
    t = np.concatenate(
        [
            np.stack([at(i, j), at(i + 1, j), at(i, j + 1)], axis=1)[up],
            np.stack([at(i, j), at(i - 1, j), at(i, j - 1)], axis=1)[down],
        ]
    )
    return Mesh.of(vertices, t)


def octahedron(tip_m: float, pieces: int = 4, grading: float = 2.5) -> Mesh:
    """An octahedral reflector: three square plates that cross at right angles, their corners at +-tip_m / 2.

    The plates are divided along the axes, so that their intersections are edges of four triangles.
    The current is singular at the rim; with edges of equal length the cross-section converges as 1 / pieces
    only: 3 pieces give 0.9 dB less than 10 (20 mm, 3 to 5 GHz). On a mesh that narrows towards the rim, 4
    pieces are within 0.1 dB of 8 (20 and 40 mm).

    Args:
        tip_m: size from tip to tip.
        pieces: mesh edges from the centre to a tip.
        grading: 1 for edges of equal length; the layer at fraction s of the distance to the rim is moved to
            1 - (1 - s)^grading.
    """
    axes = np.eye(3)
    parts = [
        _cut(np.zeros(3), u * axes[a], v * axes[b], pieces)
        for a, b in ((0, 1), (0, 2), (1, 2))
        for u in (1, -1)
        for v in (1, -1)
    ]
    mesh = Mesh.join(*parts)
    share = np.clip(np.abs(mesh.vertices).sum(axis=1), 1e-12, 1.0)
    factor = (1 - (1 - share) ** grading) / share * tip_m / 2
    return Mesh(mesh.vertices * factor[:, None], mesh.triangles, mesh.sheet_m)


def closed_octahedron(tip_m: float, pieces: int = 5) -> Mesh:
    """A regular octahedron with metal faces, its corners at +-tip_m / 2: printed and covered with foil.

    Args:
        tip_m: size from tip to tip; its edges are tip_m / sqrt(2).
        pieces: mesh edges along an edge.
    """
    axes, signs = np.eye(3) * tip_m / 2, itertools.product((1, -1), repeat=3)
    return Mesh.join(*(_cut(x * axes[0], y * axes[1], z * axes[2], pieces) for x, y, z in signs))


def tag(tip_m: float, places_m: NDArray[np.floating], pieces: int = 4, grading: float = 2.5) -> Mesh:
    """Octahedral reflectors at positions (n, 2) in the plane z = 0.

    Each has two of its upright edges, not a tip, towards the axis, so that it fits closer to a wall; one on
    the axis itself is not rotated.
    """
    reflector = octahedron(tip_m, pieces, grading)
    return Mesh.join(
        *(
            reflector.moved(
                (x, y, 0.0), float(np.arctan2(y, x) + np.pi / 4) if np.hypot(x, y) > 1e-6 else 0.0
            )
            for x, y in np.asarray(places_m, dtype=np.float64).tolist()
        )
    )


def sphere(radius_m: float, pieces: int) -> Mesh:
    """A sphere with its vertices on the surface: eight octants of pieces^2 triangles."""
    mesh = closed_octahedron(2.0, pieces)
    length = np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return Mesh(radius_m * mesh.vertices / length, mesh.triangles, mesh.sheet_m)


def _grid(origin: Floats, along: Floats, across: Floats, edge_m: float, sheet_m: complex) -> Mesh:
    """A parallelogram, its diagonals alternating so that no direction is preferred."""
    n = max(1, int(np.ceil(np.linalg.norm(along) / edge_m - 1e-9)))
    m = max(1, int(np.ceil(np.linalg.norm(across) / edge_m - 1e-9)))
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    vertices = origin + np.outer(u.ravel(), along) + np.outer(v.ravel(), across)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b, c, d = (p * (m + 1) + q for p, q in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    even = (i + j) % 2 == 0
    first = np.where(even[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(even[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return Mesh.of(vertices, np.concatenate([first, second]), sheet_m)


def plate(width_m: float, height_m: float, edge_m: float, sheet_m: complex = 0.0) -> Mesh:
    """An upright rectangular plate in the plane x = 0, centred on the origin."""
    origin = np.array([0.0, -width_m / 2, -height_m / 2])
    sides = np.array([0.0, width_m, 0.0]), np.array([0.0, 0.0, height_m])
    return _grid(origin, *sides, edge_m, sheet_m)


def _stitched(inner: int, outer: int, inner_phase: float, outer_phase: float) -> NDArray[np.int64]:
    """Triangles between two closed rings of points; index 0..inner-1, then inner..inner+outer-1.

    Both rings are traversed together; the next point is the one with the smaller angle.
    """
    step_a, step_b = 2 * np.pi / inner, 2 * np.pi / outer
    # The outer point that is nearest in angle to the inner point 0.
    start = round((inner_phase - outer_phase) / step_b)
    i, j = 0, start
    triangles = []
    while i < inner or j < start + outer:
        next_a, next_b = inner_phase + (i + 1) * step_a, outer_phase + (j + 1) * step_b
        if j == start + outer or (i < inner and next_a <= next_b):
            triangles.append((i % inner, (i + 1) % inner, inner + j % outer))
            i += 1
        else:
            triangles.append((i % inner, inner + (j + 1) % outer, inner + j % outer))
            j += 1
    return np.array(triangles, dtype=np.int64)


def revolved(
    profile: Floats, edge_m: float, across: tuple[float, float] = (1.0, 1.0), sheet_m: complex = 0.0
) -> Mesh:
    """A surface of revolution about z, or an oval one if `across` scales x and y.

    Args:
        profile: (n, 2) polyline of (radius, z); a radius of zero closes the surface.
        edge_m: target edge length.
        across: factors of x and y.
        sheet_m: of a dielectric wall (`sheet`); 0 for metal.
    """
    points = [profile[0]]
    for a, b in pairwise(profile):
        # Rows of nearly equilateral triangles are 0.87 of an edge apart; 0.95 makes them slightly slimmer.
        steps = max(1, int(np.ceil(np.linalg.norm(b - a) / (0.95 * edge_m) - 1e-9)))
        points += [a + (b - a) * k / steps for k in range(1, steps + 1)]
    widest = max(across)
    rings: list[tuple[Floats, float]] = []
    for row, (radius, z) in enumerate(points):
        count = 1 if radius < 1e-9 else max(5, int(np.ceil(2 * np.pi * radius * widest / edge_m - 1e-9)))
        phase = (row % 2) * np.pi / count
        angle = phase + 2 * np.pi * np.arange(count) / count
        x, y = across[0] * radius * np.cos(angle), across[1] * radius * np.sin(angle)
        rings.append((np.stack([x, y, np.full(count, z)], axis=1), phase))
    vertices, triangles, start = [rings[0][0]], [], 0
    for (a, phase_a), (b, phase_b) in pairwise(rings):
        if len(a) == 1 or len(b) == 1:
            ring, apex = (b, 0) if len(a) == 1 else (a, len(a))
            base = 1 if len(a) == 1 else 0
            i = np.arange(len(ring))
            t = np.stack([base + i, base + (i + 1) % len(ring), np.full(len(ring), apex)], axis=1)
        else:
            t = _stitched(len(a), len(b), phase_a, phase_b)
        vertices.append(b)
        triangles.append(t + start)
        start += len(a)
    return Mesh.of(np.concatenate(vertices), np.concatenate(triangles), sheet_m)


def can(radius_m: float, height_m: float, edge_m: float = 0.008, sheet_m: complex = 0.0) -> Mesh:
    """A can or a cup: closed at the bottom, open at the top, centred at z = 0."""
    half = height_m / 2
    profile = np.array([[0.0, -half], [radius_m, -half], [radius_m, half]])
    return revolved(profile, edge_m, sheet_m=sheet_m)


def tube(radius_m: float, height_m: float, edge_m: float = 0.008) -> Mesh:
    """A round tube without ends."""
    profile = np.array([[radius_m, -height_m / 2], [radius_m, height_m / 2]])
    return revolved(profile, edge_m)


def handle(
    start_m: float,
    reach_m: float = 0.028,
    height_m: float = 0.06,
    width_m: float = 0.01,
    edge_m: float = 0.008,
    sheet_m: complex = 0.0,
) -> Mesh:
    """A strip bent like the handle of a mug, in the plane y = 0, its ends at x = start_m, open towards them.

    Args:
        start_m: distance of its ends from the axis; a gap of 2 mm to the wall keeps the meshes apart.
        reach_m: extent from its ends outwards.
        height_m, width_m: of the handle and of its strip.
        edge_m: target edge length.
        sheet_m: see `Mesh`.
    """
    across = np.array([0.0, width_m, 0.0])
    x0, x1, h = start_m, start_m + reach_m, height_m / 2
    path = [np.array([x, -width_m / 2, z]) for x, z in ((x0, h), (x1, h), (x1, -h), (x0, -h))]
    return Mesh.join(*(_grid(a, b - a, across, edge_m, sheet_m) for a, b in pairwise(path)))


def helmet(
    half_axes_m: tuple[float, float, float], skirt_m: float, edge_m: float = 0.011, sheet_m: complex = 0.0
) -> Mesh:
    """Half an ellipsoid above z = 0, open below, with a straight skirt of skirt_m below z = 0."""
    ax, ay, az = half_axes_m
    mean = (ax + ay) / 2
    rows = max(3, int(np.ceil(np.pi / 4 * (mean + az) / (0.95 * edge_m))))
    elevation = np.linspace(0, np.pi / 2, rows + 1)
    dome = np.stack([mean * np.cos(elevation), az * np.sin(elevation)], axis=1)
    dome[-1, 0] = 0.0
    # The steps of the dome already have the length of an edge and must not be divided again.
    profile = np.concatenate([[[mean, -skirt_m]], dome]) if skirt_m > 0 else dome
    return revolved(profile, edge_m * 1.06, (ax / mean, ay / mean), sheet_m)


def box(sides_m: tuple[float, float, float], edge_m: float = 0.01, sheet_m: complex = 0.0) -> Mesh:
    """A rectangular box, open at the top, centred on the origin."""
    x, y, z = np.diag(sides_m)
    low = -np.asarray(sides_m) / 2
    faces = [(low, x, y), (low, x, z), (low, y, z), (low + x, y, z), (low + y, x, z)]
    return Mesh.join(*(_grid(o, u, v, edge_m, sheet_m) for o, u, v in faces))
