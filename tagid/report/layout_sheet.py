"""A layout on paper and in the terminal: the plan with its dimensions, and the template for its reflectors.

The plan is seen from above with the axis in the middle, x to the right, as positions are given in files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.report.drafting import Circle, Drawing, Line, Text
from tagid.tags.design import REFLECTOR_M
from tagid.tags.layout import Layout

EDGE_MM = 32.0
CHECK_MM = 100.0
"""Length of the bar by which a print is measured."""


def plan(layout: Layout) -> Drawing:
    """Seen from above at 1:1: axis, rows, reflectors with number, radius, angle and height, and gaps."""
    half = layout.radius_m * 1e3 + EDGE_MM
    lines = 3 + layout.size
    foot = 6.0 * lines + 12
    sheet = Drawing(max(2 * half, CHECK_MM + 20), 2 * half + foot)
    cx, cy = sheet.width / 2, foot + half
    sheet.add(
        Line((cx - half + 6, cy), (cx + half - 6, cy), 0.2, True),
        Line((cx, cy - half + 6), (cx, cy + half - 6), 0.2, True),
        Text((cx + half - 4, cy), "x"),
        Text((cx, cy + half - 4), "y"),
    )
    places = layout.positions * 1e3
    heights = np.asarray(layout.heights) * 1e3
    for radius in sorted({round(float(r), 1) for r in np.linalg.norm(places, axis=1)} - {0.0}):
        sheet.add(Circle((cx, cy), radius, 0.2, True))
    for number, (x, y) in enumerate(places, 1):
        at = (cx + float(x), cy + float(y))
        sheet.add(Circle(at, REFLECTOR_M * 500, 0.3))
        sheet.cross(at, 5.0)
        outward = np.array([x, y]) / max(float(np.hypot(x, y)), 1e-9)
        sheet.add(Text((at[0] + 8 * outward[0] + 6, at[1] + 8 * outward[1] + 5), str(number), 5.0))
    for i, j in _sides(layout):
        a, b = places[i], places[j]
        middle = (a + b) / 2
        sheet.add(
            Line((cx + a[0], cy + a[1]), (cx + b[0], cy + b[1]), 0.15, True),
            Text((cx + middle[0], cy + middle[1] + 3), f"{np.linalg.norm(a - b):.1f}", 3.5),
        )
    rows = [f"{layout.name}   {layout.label}   (from above, millimetres, 1:1)"]
    for number, ((x, y), h) in enumerate(zip(places, heights, strict=True), 1):
        rows.append(
            f"{number}:  radius {np.hypot(x, y):.1f}   angle {np.rad2deg(np.arctan2(y, x)) % 360:.1f} deg   "
            f"x {x + 0.0:.1f}   y {y + 0.0:.1f}" + (f"   height {h:.1f}" if heights.any() else "")
        )
    for line, text in enumerate(rows):
        sheet.add(Text((8, foot - 6.0 * (line + 1)), text, 3.8, "start"))
    _check_bar(sheet, (8.0, 7.0))
    return sheet


def strip(layout: Layout, surface_radius_m: float | None = None) -> Drawing:
    """The object's side unrolled at 1:1: a strip to wrap round it, with a cross for every reflector.

    Args:
        layout: its reflectors sit on circles around the axis.
        surface_radius_m: radius at which the strip lies on the object, m; None takes that of the outermost
            reflectors' centres.

    Raises UsageError where a reflector sits on the axis: there is no side to unroll.
    """
    radii = np.linalg.norm(layout.positions, axis=1)
    if radii.min() < 0.01:
        raise UsageError(
            f"layout {layout.name} has a reflector on the axis, so it cannot be unrolled", "Use the plan."
        )
    radius = (surface_radius_m if surface_radius_m is not None else float(radii.max())) * 1e3
    if not 5 <= radius <= 1500:
        raise UsageError(f"the surface radius is {radius:.0f} mm", "Give metres, e.g. --surface-radius 0.11.")
    length = 2 * np.pi * radius
    heights = np.asarray(layout.heights) * 1e3
    low, high = float(heights.min()), float(heights.max())
    sheet = Drawing(max(length + 20, CHECK_MM + 20), high - low + 70)
    bottom = 22.0
    left, y0 = 10.0, bottom + 22 - low
    top = sheet.height - 6
    sheet.add(
        Line((left, bottom), (left + length, bottom)),
        Line((left, top), (left + length, top)),
        Line((left, bottom), (left, top)),
        Line((left + length, bottom), (left + length, top)),
        Line((left, y0), (left + length, y0), 0.2, True),
    )
    angles = np.rad2deg(np.arctan2(layout.positions[:, 1], layout.positions[:, 0])) % 360
    begin = _widest_gap_deg(angles)
    for degrees in range(0, 361, 10):
        x = left + length * degrees / 360
        tall = (degrees + begin) % 30 == 0
        sheet.add(Line((x, bottom), (x, bottom + (4 if tall else 2)), 0.2))
        if tall:
            sheet.add(Text((x, bottom + 6.5), f"{(degrees + begin) % 360}", 3.0))
    for number, (angle, height, r) in enumerate(zip(angles, heights, radii, strict=True), 1):
        along = length * ((float(angle) - begin) % 360) / 360
        at = (left + along, y0 + float(height))
        sheet.add(Circle(at, REFLECTOR_M * 500, 0.2, True))
        sheet.cross(at, 6.0)
        about = f"{number}: {angle:.1f} deg, {along:.1f} from the left, r {r * 1e3:.1f}"
        sheet.add(Text((at[0], at[1] - 9), about, 3.0))
    sheet.add(
        Text(
            (left, 16),
            f"{layout.name}: print outwards, 0 deg is +x, {length:.1f} mm round, "
            f"surface radius {radius:.1f} mm",
            3.2,
            "start",
        )
    )
    _check_bar(sheet, (left, 7.0))
    return sheet


def template(layout: Layout, surface_radius_m: float | None = None) -> list[Drawing]:
    """What to print for a layout: the plan, and the strip where it can be unrolled."""
    if np.linalg.norm(layout.positions, axis=1).min() < 0.01:
        return [plan(layout)]
    return [plan(layout), strip(layout, surface_radius_m)]


def stacked(drawings: list[Drawing]) -> Drawing:
    """Several drawings one below the other as one, the first on top."""
    sheet = Drawing(max(d.width for d in drawings), sum(d.height for d in drawings))
    bottom = sheet.height
    for drawing in drawings:
        bottom -= drawing.height
        for mark in drawing.marks:
            if isinstance(mark, Line):
                start, end = ((x, y + bottom) for x, y in (mark.start, mark.end))
                sheet.add(Line(start, end, mark.width, mark.dashed))
            elif isinstance(mark, Circle):
                x, y = mark.centre
                sheet.add(Circle((x, y + bottom), mark.radius, mark.width, mark.dashed, mark.filled))
            else:
                sheet.add(Text((mark.at[0], mark.at[1] + bottom), mark.text, mark.size, mark.anchor))
    return sheet


def in_terminal(layout: Layout, width: int = 45) -> str:
    """The plan in characters: + the axis, . the circles, digits and letters the reflectors."""
    rows = width // 2 | 1
    reach = layout.radius_m * 1.1
    grid = [[" "] * width for _ in range(rows)]

    def put(x: float, y: float, character: str) -> None:
        column = round((x / reach + 1) / 2 * (width - 1))
        row = round((1 - y / reach) / 2 * (rows - 1))
        grid[row][column] = character

    for radius in {round(float(r), 4) for r in np.linalg.norm(layout.positions, axis=1)}:
        for angle in np.linspace(0, 2 * np.pi, 120):
            put(radius * float(np.cos(angle)), radius * float(np.sin(angle)), ".")
    put(0.0, 0.0, "+")
    for number, (x, y) in enumerate(layout.positions):
        put(float(x), float(y), "123456789ABCDEFG"[number])
    return "\n".join("".join(row).rstrip() for row in grid)


def _widest_gap_deg(angles: NDArray[np.float64]) -> int:
    """The middle of the widest gap between angles, deg, to ten degrees: where a strip is best cut."""
    order = np.sort(angles)
    gap = np.diff(np.append(order, order[0] + 360))
    i = int(np.argmax(gap))
    return int(round((order[i] + gap[i] / 2) / 10) * 10) % 360


def _sides(layout: Layout) -> list[tuple[int, int]]:
    """Pairs of reflectors next to each other around the layout's middle, whose distance is worth drawing."""
    offset = layout.positions - layout.positions.mean(axis=0)
    order = np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))
    pairs = list(zip(order, np.roll(order, -1), strict=True))
    return [(int(i), int(j)) for i, j in (pairs if layout.size > 2 else pairs[:1])]


def _check_bar(sheet: Drawing, at: tuple[float, float]) -> None:
    x, y = at
    sheet.add(Line((x, y), (x + CHECK_MM, y), 0.4), Line((x, y - 2), (x, y + 2)))
    sheet.add(Line((x + CHECK_MM, y - 2), (x + CHECK_MM, y + 2)))
    sheet.add(Text((x + CHECK_MM / 2, y + 3), "100 mm: measure it after printing", 3.0))
