"""Images and volumes as files for other programs: NPZ, VTK image data (.vti), point cloud or surface (.ply).

VTK: "VTK XML file formats", appended raw data with a 64-bit length. PLY: Turk, "The PLY polygon file format"
(1994), binary little-endian.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.files import write_bytes
from tagid.imaging.types import Image
from tagid.imaging.volume import Volume

_CORNERS = np.array([[z, y, x] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
_TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Corners of the six tetrahedra about the diagonal from corner 0 to corner 7, all of positive orientation."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed or bounded surface.

    Attributes:
        points: (n, 3) float64 vertices x, y, z.
        triangles: (m, 3) int32 numbers of vertices, counter-clockwise seen from the side of smaller values.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]


def isosurface(values: NDArray[np.floating], level: float, axes: tuple[NDArray[np.floating], ...]) -> Surface:
    """The surface at which linearly interpolated values equal a level.

    Args:
        values: (levels, rows, columns), z, y, x.
        level: of the surface.
        axes: coordinates of the values along z, y and x.
    """
    shape = np.array(values.shape)
    above = values > level
    corner = [above[tuple(slice(o, n - 1 + o) for o, n in zip(at, shape, strict=True))] for at in _CORNERS]
    count = np.sum(corner, axis=0)
    cubes = np.stack(np.nonzero((count > 0) & (count < 8)), axis=1)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(cubes[:, None] + _CORNERS, 2, 0)), values.shape)
    ends = numbers[:, _TETRAHEDRA].reshape(-1, 4)
    inside = above.ravel()[ends]
    edges = np.concatenate(
        [_one_inside(ends, inside), _one_inside(ends, ~inside)[:, ::-1], _two(ends, inside)]
    )
    if not len(edges):
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    pairs, triangles = np.unique(np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    flat = values.ravel().astype(np.float64)
    first, second = flat[pairs[:, 0]], flat[pairs[:, 1]]
    part = (level - first) / (second - first)
    coordinates = [
        np.asarray(axis)[index]
        for axis, index in zip(axes, np.unravel_index(pairs, values.shape), strict=True)
    ]
    ends_at = np.stack(coordinates[::-1], axis=-1)
    points = ends_at[:, 0] + part[:, None] * (ends_at[:, 1] - ends_at[:, 0])
    return Surface(points, triangles.reshape(-1, 3).astype(np.int32))


def _one_inside(ends: NDArray[np.intp], inside: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(n, 3, 2) edges of the triangles of tetrahedra with one corner inside."""
    some = ends[inside.sum(axis=1) == 1]
    which = np.argmax(inside[inside.sum(axis=1) == 1], axis=1)
    # The other corners in the order in which they turn about the first one, for each place of that.
    others = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])[which]
    apex = np.take_along_axis(some, which[:, None], axis=1)
    rest = np.take_along_axis(some, others, axis=1)
    return np.stack([np.broadcast_to(apex, rest.shape), rest], axis=-1)


def _two(ends: NDArray[np.intp], inside: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(2 n, 3, 2) edges of the two triangles each of tetrahedra with two corners inside."""
    chosen = inside.sum(axis=1) == 2
    some, order = ends[chosen], np.argsort(~inside[chosen], axis=1, kind="stable")
    a, b, c, d = np.take_along_axis(some, order, axis=1).T
    # A permutation of odd parity turns the tetrahedron inside out.
    odd = np.array([np.linalg.det(np.eye(4)[row]) < 0 for row in order], dtype=bool)
    c, d = np.where(odd, d, c), np.where(odd, c, d)
    ac, ad, bd, bc = (np.stack(pair, axis=-1) for pair in ((a, c), (a, d), (b, d), (b, c)))
    return np.concatenate([np.stack([ac, ad, bd], axis=1), np.stack([ac, bd, bc], axis=1)])


CLOUD_DB = 20.0
"""Dynamic range of the point cloud: voxels down to this level below the brightest are points, if no
neighbour along an axis is brighter."""

SURFACE_DB = 10.0
"""Level of the surface below the brightest voxel: below the null of the point response, above its sidelobes
after a fit."""


def write_image(path: Path, image: Image) -> None:
    """Write `image` complex64 (y, x), `x_m`, `y_m` and `settings` (JSON) as NPZ, atomically.

    Raises StorageError, DiskFullError.
    """
    x_m, y_m = (image.grid.axis + middle for middle in image.centre_m)
    write_bytes(
        path, _npz({"image": image.values.astype(np.complex64), "x_m": x_m, "y_m": y_m}, image.settings)
    )


def _npz(arrays: dict[str, Any], settings: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, settings=np.array(json.dumps(settings, default=str)))
    return buffer.getvalue()


def _axes(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates of the voxels along z, y and x, m."""
    x_m, y_m = (volume.grid.square.axis + middle for middle in volume.centre_m)
    return volume.grid.heights, y_m, x_m


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume atomically, in the format that the suffix names.

    .npz: `volume` complex64 (z, y, x), `x_m`, `y_m`, `z_m`, `settings` (JSON). .vti: point data `magnitude`
    and `phase`. .ply: points with `magnitude`.

    Raises:
        UsageError: another suffix. StorageError, DiskFullError.
    """
    writers = {".npz": _volume_npz, ".vti": _vti, ".ply": _ply}
    if path.suffix not in writers:
        raise UsageError(f"{path} has no suffix of a volume file", f"Use one of {', '.join(writers)}.")
    write_bytes(path, writers[path.suffix](volume))


def write_surface(path: Path, volume: Volume) -> None:
    """Write the surface `SURFACE_DB` below the brightest voxel as PLY triangles, atomically.

    Raises:
        UsageError: a volume with fewer than two voxels along an axis. StorageError, DiskFullError.
    """
    magnitude = np.abs(volume.values)
    if min(magnitude.shape) < 2:
        raise UsageError(
            f"a volume of {magnitude.shape} voxels has no surface",
            "Use at least two `levels` and `imaging.pixels`.",
        )
    # A frame of zeros closes the surface where the object reaches the volume's border.
    axes = [_framed(values) for values in _axes(volume)]
    level = float(magnitude.max()) * 10 ** (-SURFACE_DB / 20)
    surface = isosurface(np.pad(magnitude, 1), level if level > 0 else 1.0, tuple(axes))
    faces = np.zeros(len(surface.triangles), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, surface.triangles
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(surface.points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    write_bytes(path, head.encode("ascii") + surface.points.astype("<f4").tobytes() + faces.tobytes())


def _framed(axis: NDArray[np.floating]) -> NDArray[np.float64]:
    """An axis with one more value on both sides."""
    step = axis[1] - axis[0]
    return np.concatenate([[axis[0] - step], axis, [axis[-1] + step]])


def _volume_npz(volume: Volume) -> bytes:
    z_m, y_m, x_m = _axes(volume)
    return _npz(
        {"volume": volume.values.astype(np.complex64), "x_m": x_m, "y_m": y_m, "z_m": z_m}, volume.settings
    )


def _vti(volume: Volume) -> bytes:
    levels, rows, columns = volume.values.shape
    extent = f"0 {columns - 1} 0 {rows - 1} 0 {levels - 1}"
    step = volume.grid.square.step
    origin = " ".join(repr(float(axis[0])) for axis in _axes(volume)[::-1])
    arrays = {
        "magnitude": np.abs(volume.values).astype("<f4"),
        "phase": np.angle(volume.values).astype("<f4"),
    }
    parts, offset, lines = [], 0, []
    for name, values in arrays.items():
        lines.append(f'<DataArray type="Float32" Name="{name}" format="appended" offset="{offset}"/>')
        data = np.uint64(values.nbytes).astype("<u8").tobytes() + values.tobytes()
        parts.append(data)
        offset += len(data)
    head = (
        '<?xml version="1.0"?>\n'
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" Origin="{origin}" '
        f'Spacing="{float(step)!r} {float(step)!r} {float(volume.grid.rise)!r}">\n'
        f'<Piece Extent="{extent}">\n<PointData Scalars="magnitude">\n'
        + "\n".join(lines)
        + "\n</PointData>\n"
        '<CellData/>\n</Piece>\n</ImageData>\n<AppendedData encoding="raw">\n_'
    )
    return head.encode("ascii") + b"".join(parts) + b"\n</AppendedData>\n</VTKFile>\n"


def _ply(volume: Volume) -> bytes:
    magnitude = np.abs(volume.values)
    bright = magnitude >= magnitude.max(initial=0.0) * 10 ** (-CLOUD_DB / 20)
    bright &= magnitude > 0
    for axis in range(3):
        padded = np.pad(magnitude, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        before, after = (
            np.take(padded, range(start, start + magnitude.shape[axis]), axis) for start in (0, 2)
        )
        bright &= (magnitude >= before) & (magnitude >= after)
    z, y, x = np.nonzero(bright)
    z_m, y_m, x_m = _axes(volume)
    points = np.zeros(len(x), dtype=[(name, "<f4") for name in ("x", "y", "z", "magnitude")])
    points["x"], points["y"], points["z"] = x_m[x], y_m[y], z_m[z]
    points["magnitude"] = magnitude[bright]
    properties = "".join(f"property float {name}\n" for name in points.dtype.names or ())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return head.encode("ascii") + points.tobytes()
