"""A reflector to make: a printable solid, a net to cut and fold at 1:1, and its radar cross-section.

The octahedron's size is the distance from tip to tip; its twelve edges are size / sqrt(2). Nets and solids
are in millimetres.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import UsageError
from tagid.report.axes import Axes
from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, ORANGE
from tagid.report.drafting import Drawing, Line, Text
from tagid.report.layout_sheet import check_bar
from tagid.types import Floats

SIZES_M = (0.010, 0.080)
"""Supported sizes, m: smaller ones cannot be folded, larger ones are not small reflectors."""
TAB_MM = 6.0
"""Width of a glue tab."""
_EDGE_MM = 12.0
_FOOT_MM = 58.0
TABLE = resources.files("tagid.report") / "octahedron.json"
"""Solved levels over sizes in wavelengths and aspects, made by `python -m train.octahedron`."""


def check_size(size_m: float) -> None:
    """Raise UsageError for an unsupported size."""
    low, high = SIZES_M
    if not low <= size_m <= high:
        raise UsageError(
            f"a reflector of {size_m * 1e3:g} mm from tip to tip",
            f"Give {low * 1e3:g} to {high * 1e3:g}, in millimetres, e.g. `size=40`.",
        )


def solid(size_m: float) -> Floats:
    """(8, 3, 3) mm: the octahedron's faces, corners counter-clockwise from outside, tips at +-size / 2."""
    check_size(size_m)
    half = size_m * 1e3 / 2
    faces = []
    for x in (1, -1):
        for y in (1, -1):
            for z in (1, -1):
                corners = np.diag([x, y, z]) * half
                faces.append(corners if x * y * z > 0 else corners[[0, 2, 1]])
    return np.array(faces, dtype=np.float64)


def to_stl(size_m: float) -> bytes:
    """The solid as a binary STL file, millimetres: one closed surface of eight facets."""
    faces = solid(size_m)
    head = f"tagid octahedron, {size_m * 1e3:g} mm from tip to tip, millimetres".encode().ljust(80)
    parts = [head, struct.pack("<I", len(faces))]
    for corners in faces:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        parts.append(struct.pack("<12fH", *normal, *corners.ravel(), 0))
    return b"".join(parts)


_BAND = (triangle for i in range(3) for triangle in ((i, i + 1, 4 + i), (4 + i, i + 1, 5 + i)))
TRIANGLES = (*_BAND, (5, 6, 8), (1, 9, 2))
"""Points of the net's triangles, each sharing an edge with an earlier one."""
EDGES = Counter((min(a, b), max(a, b)) for t in TRIANGLES for a, b in pairwise((*t, t[0])))
"""Edges (lower, higher point) and how many triangles have them: 2 fold, 1 cut."""
TABS = ((3, 7), (6, 8), (8, 5), (1, 9), (9, 2))
"""Edges (start, end) that carry a glue tab on their right-hand side."""


def net(size_m: float) -> Floats:
    """(10, 2) mm: the octahedron unfolded, a band of six triangles with one above and one below its middle.

    Points 0 to 3 are the band's lower corners, 4 to 7 its upper ones, 8 the tip above, 9 the tip below.
    """
    check_size(size_m)
    edge = size_m * 1e3 / np.sqrt(2)
    height = edge * np.sqrt(3) / 2
    points = [(i * edge, 0.0) for i in range(4)] + [((i + 0.5) * edge, height) for i in range(4)]
    return np.array([*points, (2 * edge, 2 * height), (1.5 * edge, -height)])


def sheet(size_m: float) -> Drawing:
    """The net at 1:1 with a 100 mm scale bar, and a drawing that shows the definition of the size."""
    flat = net(size_m)
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = TAB_MM + _EDGE_MM
    width = max(float(high[0] - low[0]) + 2 * room, 190.0)
    size = size_m * 1e3
    drawing = Drawing(width, float(high[1] - low[1]) + 2 * room + _FOOT_MM + size)
    shift = np.array([room - low[0], _FOOT_MM + size + room - low[1]])
    points = flat + shift

    def point(index: int) -> tuple[float, float]:
        return float(points[index][0]), float(points[index][1])

    tabbed = {tuple(sorted(edge)) for edge in TABS}
    for (a, b), count in EDGES.items():
        drawing.add(Line(point(a), point(b), 0.3, dashed=count == 2 or (a, b) in tabbed))
    for start, end in TABS:
        corners = _tab(points[start], points[end])
        drawing.add(*(Line(*pair, 0.3) for pair in pairwise(corners)))
    _dimension(drawing, (30.0, 34.0), size)
    rows = (
        f"Octahedron, size {size:g} mm from tip to tip, edge {size / np.sqrt(2):.1f} mm. Scale 1:1.",
        "Cut along solid lines, fold backwards along dashed ones, glue the tabs inside.",
        "Use foil-covered card, foil outside: all eight faces must be metal, gaps up to 2 mm are harmless.",
    )
    for line, text in enumerate(rows):
        drawing.add(Text((8.0, 25.0 - 6.0 * line), text, 3.6, "start"))
    check_bar(drawing, (8.0, 5.0))
    return drawing


def _tab(start: Floats, end: Floats) -> list[tuple[float, float]]:
    """The outline of a glue tab outside an edge, its ends cut at 45 degrees."""
    along = (end - start) / np.linalg.norm(end - start)
    out = np.array([along[1], -along[0]])
    corners = (start, start + TAB_MM * (along + out), end + TAB_MM * (out - along), end)
    return [(float(x), float(y)) for x, y in corners]


def _dimension(drawing: Drawing, at: tuple[float, float], size: float) -> None:
    """The octahedron seen along an axis, a square on its tip, with its size and its edge."""
    x, y = at
    half = size / 2
    cx, cy = x + half, y + half
    tips = [(cx - half, cy), (cx, cy - half), (cx + half, cy), (cx, cy + half)]
    for a, b in zip(tips, (*tips[1:], tips[0]), strict=True):
        drawing.add(Line(a, b, 0.3))
    drawing.add(Line(tips[0], tips[2], 0.2, dashed=True), Line(tips[1], tips[3], 0.2, dashed=True))
    below = cy - half - 4
    drawing.add(
        Line((cx - half, below), (cx + half, below), 0.2),
        Line((cx - half, cy), (cx - half, below - 1), 0.15),
        Line((cx + half, cy), (cx + half, below - 1), 0.15),
        Text((cx + half + 6, below), f"size {size:g} mm, from tip to tip", 3.6, "start"),
        Text((cx + half / 2 + 5, cy + half / 2 + 3), f"edge {size / np.sqrt(2):.1f} mm", 3.6, "start"),
    )


@dataclass(frozen=True, eq=False)
class CrossSection:
    """Computed radar cross-section of an octahedron with metal faces, one tip up.

    Attributes:
        size_m: tip to tip.
        frequency_hz: (F,).
        aspect_deg: (A,) azimuth of the antenna, 0 towards a tip.
        vertical, horizontal: (F, A) dBsm in the two polarisations.
        source: how they were computed.
    """

    size_m: float
    frequency_hz: Floats
    aspect_deg: Floats
    vertical: Floats
    horizontal: Floats

    source: str


def cross_section(size_m: float) -> CrossSection:
    """The octahedron from 3.1 to 4.9 GHz over 90 degrees of aspect; the pattern repeats after that.

    The cross-section over the square of the size depends on the size in wavelengths alone: it is taken from
    the solutions in `TABLE`. Raises UsageError: an unsupported size.
    """
    check_size(size_m)
    table = json.loads(TABLE.read_text())
    frequency = np.linspace(3.1e9, 4.9e9, 7)
    size = size_m * frequency / SPEED_OF_LIGHT
    level = 10 * np.log10(4 * np.pi * size_m**2)
    vertical, horizontal = (
        level
        + np.stack([np.interp(size, table["wavelengths"], column) for column in np.transpose(table[name])], 1)
        for name in ("vertical_db", "horizontal_db")
    )
    aspect = np.array(table["aspect_deg"])
    return CrossSection(size_m, frequency, aspect, vertical, horizontal, table["source"])


def to_csv(solved: CrossSection) -> str:
    """The table: one line per frequency, polarisation and aspect, dBsm."""
    rows = [f"# octahedron, {solved.size_m * 1e3:g} mm from tip to tip; {solved.source}"]
    rows.append("frequency_ghz,polarisation," + ",".join(f"{a:g}_deg" for a in solved.aspect_deg))
    for name, table in (("V", solved.vertical), ("H", solved.horizontal)):
        for frequency, levels in zip(solved.frequency_hz, table, strict=True):
            rows.append(f"{frequency / 1e9:.2f},{name}," + ",".join(f"{level:.2f}" for level in levels))
    return "\n".join(rows) + "\n"


def to_png(solved: CrossSection) -> bytes:
    """Two diagrams: the level over frequency, and over aspect at 4 GHz, in both polarisations."""
    canvas = Canvas(1100, 520)
    both = np.concatenate([solved.vertical.ravel(), solved.horizontal.ravel()])
    limits = (float(np.floor(both.min() / 5) * 5), float(np.ceil(both.max() / 5) * 5))
    ghz = solved.frequency_hz / 1e9
    left = Axes(canvas, (110, 70, 520, 420), (float(ghz[0]), float(ghz[-1])), limits)
    right = Axes(canvas, (660, 70, 1070, 420), (0.0, 90.0), limits)
    middle = int(np.argmin(np.abs(ghz - 4.0)))
    for axes in (left, right):
        axes.grid()
    for table, colour in ((solved.vertical, BLUE), (solved.horizontal, ORANGE)):
        for column in (0, len(solved.aspect_deg) // 2):
            left.curve(ghz, table[:, column], colour, 3 if column == 0 else 1.5)
        right.curve(solved.aspect_deg, table[middle], colour, 3)
    left.frame("frequency, GHz", "RCS, dBsm", f"octahedron {solved.size_m * 1e3:g} mm, tip to tip")
    right.frame("aspect, degrees from a tip", "RCS, dBsm", f"at {ghz[middle]:.1f} GHz")
    canvas.text((110, 490), "vertical polarisation", 20, BLUE)
    canvas.text((330, 490), "horizontal; thick: towards a tip, thin: 45 degrees", 20, ORANGE)
    return canvas.png()
