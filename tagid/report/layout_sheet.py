"""Layout drawings: dimensioned plan, terminal plan, and 1:1 reflector template.

The plan is seen from above with the axis in the centre, x to the right, as in layout files.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tagid.counting import counted
from tagid.errors import UsageError
from tagid.report.drafting import Circle, Drawing, Line, Text, moved, room
from tagid.tags.layouts.design import REFLECTOR_M
from tagid.tags.layouts.layout import Layout
from tagid.tags.layouts.test_card import NAME as TEST_CARD

EDGE_MM = 28.0
"""Landscape fits the plan of a helmet on two A4 sheets."""
CUT_MM = 6.0
"""Space for the letter at a cut."""
SPOT_MM = 23.0
"""Half the width of a reflector and its labels on the strip; cuts avoid this area if possible."""
STRIP_FOOT_MM = 22.0
CELL_MM = (60.0, 80.0)
"""Width and height of a picture in the overview."""
GLUED_WITHIN_MM = 1.0
"""Distance of reflectors from their marks up to which a tag keeps its name (docs/results/positions.md)."""
CHECK_MM = 100.0
"""Length of the scale bar for checking a print."""


def plan(layout: Layout) -> Drawing:
    """Seen from above at 1:1: axis, rows, reflectors with number, radius, angle and height, and gaps."""
    half = layout.radius_m * 1e3 + EDGE_MM
    lines = 6 + layout.size
    foot = 6.0 * lines + 12
    sheet = Drawing(max(2 * half, CHECK_MM + 20), 2 * half + foot)
    cx, cy = sheet.width / 2, foot + half
    sheet.add(
        Line((cx - half + 6, cy), (cx + half - 6, cy), 0.2, True),
        Line((cx, cy - half + 6), (cx, cy + half - 6), 0.2, True),
        Text((cx + half - 4, cy), "x"),
        Text((cx, cy + half - 4), "y"),
    )
    marks_mm = layout.positions * 1e3
    heights = np.asarray(layout.heights) * 1e3
    circles = sorted({round(float(r), 1) for r in np.linalg.norm(marks_mm, axis=1)} - {0.0})
    for radius in circles:
        sheet.add(Circle((cx, cy), radius, 0.2, True))
    for i, j in _sides(layout):
        a, b = marks_mm[i], marks_mm[j]
        if (np.linalg.norm(marks_mm - (a + b) / 2, axis=1) < 10).any():
            continue  # another reflector is at the position of the label
        middle = (a + b) / 2
        sheet.add(
            Line((cx + a[0], cy + a[1]), (cx + b[0], cy + b[1]), 0.15, True),
            Text((cx + middle[0], cy + middle[1]), f"{np.linalg.norm(a - b):.1f}", 3.5),
        )
    for number, (x, y) in enumerate(marks_mm, 1):
        at = (cx + float(x), cy + float(y))
        raised = bool(heights[number - 1] != heights.min())
        sheet.add(Circle(at, REFLECTOR_M * 500, 0.3, raised))
        sheet.cross(at, 5.0)
        reach = float(np.hypot(x, y))
        outward = np.array([x, y]) / reach if reach > 1 else np.array([0.7, 0.7])
        # Beside the axes and the circles, which pass through the reflector.
        aside = 8.0 * (outward + np.array([-outward[1], outward[0]]))
        sheet.add(Text((at[0] + float(aside[0]), at[1] + float(aside[1])), str(number), 5.0))
        if reach > 1:
            sheet.add(Line((cx, cy), at, 0.1, True))
    free = np.deg2rad(_widest_gap_deg(np.rad2deg(np.arctan2(marks_mm[:, 1], marks_mm[:, 0])) % 360))
    for radius in circles:
        end = cx + radius * float(np.cos(free)), cy + radius * float(np.sin(free))
        sheet.add(Text(end, f"R {radius:.1f}", 3.5))
    rows = [f"{layout.name}   {layout.label}   (from above, millimetres, 1:1)"]
    rows.append(f"Circles: reflectors of size {REFLECTOR_M * 1e3:.0f} mm, measured from tip to tip.")
    rows.append(
        f"Glue the centre of each within {GLUED_WITHIN_MM:g} mm of its mark, or enroll the tag as built."
    )
    if len(set(heights.tolist())) > 1:
        rows.append("A dashed outline is a reflector above the lowest row.")
    for number, ((x, y), h) in enumerate(zip(marks_mm, heights, strict=True), 1):
        rows.append(
            f"{number}:  radius {np.hypot(x, y):.1f}   angle {np.rad2deg(np.arctan2(y, x)) % 360:.1f} deg   "
            f"x {x + 0.0:.1f}   y {y + 0.0:.1f}" + (f"   height {h:.1f}" if heights.any() else "")
        )
    for line, text in enumerate(rows):
        sheet.add(Text((8, foot - 6.0 * (line + 1)), text, 3.8, "start"))
    check_bar(sheet, (8.0, 7.0))
    sheet.marks.sort(key=lambda mark: isinstance(mark, Text))  # no line crosses a label
    return sheet


def overview(layouts: Sequence[Layout], width: float, height: float) -> list[Drawing]:
    """Pictures of layouts with their names, not to scale, on sheets of up to the width and height, mm."""
    across, down = int(width // CELL_MM[0]), int(height // CELL_MM[1])
    sheets = []
    for first in range(0, len(layouts), across * down):
        shown = layouts[first : first + across * down]
        sheet = Drawing(across * CELL_MM[0], -(-len(shown) // across) * CELL_MM[1])
        for i, layout in enumerate(shown):
            x = (i % across + 0.5) * CELL_MM[0]
            y = sheet.height - (i // across) * CELL_MM[1] - CELL_MM[0] / 2
            _picture(sheet, layout, (x, y))
        sheets.append(sheet)
    return sheets


def _picture(sheet: Drawing, layout: Layout, at: tuple[float, float]) -> None:
    """A small picture from above, with the name, the label and the radius below."""
    scale = 0.38 * CELL_MM[0] / layout.radius_m
    for radius in sorted({round(float(r), 4) for r in np.linalg.norm(layout.positions, axis=1)} - {0.0}):
        sheet.add(Circle(at, radius * scale, 0.2, True))
    sheet.cross(at, 2.0)
    for x, y in layout.positions * scale:
        sheet.add(Circle((at[0] + float(x), at[1] + float(y)), 2.5, filled=True))
    about = f"{counted(layout.size, 'reflector')}, radius {layout.radius_m * 1e3:.0f} mm"
    below = at[1] - CELL_MM[0] / 2
    for line, (text, size) in enumerate(((layout.name, 4.0), (layout.label, 3.0), (about, 3.0))):
        fits = min(size, 1.8 * CELL_MM[0] / max(len(text), 1))
        sheet.add(Text((at[0], below - 6 * line - 3), text, fits))


def strip(layout: Layout, surface_radius_m: float | None = None) -> Drawing:
    """The object's side unrolled at 1:1: a strip to wrap around it, with a cross for every reflector.

    Args:
        layout: its reflectors lie on circles around the axis.
        surface_radius_m: radius of the surface under the strip, m; None uses that of the outermost
            reflectors' centres.

    Raises UsageError if a reflector is on the axis, where no surface can be unrolled.
    """
    radii = np.linalg.norm(layout.positions, axis=1)
    if radii.min() < 0.01:
        raise UsageError(
            f"layout {layout.name} has a reflector on the axis, so it cannot be unrolled", "Use the plan."
        )
    radius = (surface_radius_m if surface_radius_m is not None else float(radii.max())) * 1e3
    if not 5 <= radius <= 1500:
        raise UsageError(f"the surface radius is {radius:.0f} mm", "Give metres, e.g. `surface_radius=0.11`.")
    length = 2 * np.pi * radius
    heights = np.asarray(layout.heights) * 1e3
    low, high = float(heights.min()), float(heights.max())
    sheet = Drawing(max(length + 20, CHECK_MM + 20), high - low + 78)
    bottom = STRIP_FOOT_MM
    left, y0 = 10.0, bottom + 30 - low
    top = sheet.height - 6
    sheet.add(
        Line((left, bottom), (left + length, bottom)),
        Line((left, top), (left + length, top)),
        Line((left, bottom), (left, top)),
        Line((left + length, bottom), (left + length, top)),
    )
    rows = sorted({0.0, *heights.tolist()})
    sheet.add(*(Line((left, y0 + row), (left + length, y0 + row), 0.2, True) for row in rows))
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
        # In the circle, whose chord here is 35 mm, and clear of the cross.
        high_mark = f"r {r * 1e3:.1f}" + (f", height {height:.1f}" if low < high else "")
        sheet.add(
            Text((at[0], at[1] + 9), f"{number}: {angle:.1f} deg", 3.0),
            Text((at[0], at[1] - 8), f"{along:.1f} from the left", 2.6),
            Text((at[0], at[1] - 12), high_mark, 2.6),
        )
    sheet.add(
        Text(
            (left, 16),
            f"{layout.name}: printed side out, join A to A, 0 deg is +x, {length:.1f} mm around, "
            f"surface radius {radius:.1f} mm",
            3.2,
            "start",
        )
    )
    check_bar(sheet, (left, 7.0))
    return sheet


def template(
    layout: Layout, surface_radius_m: float | None = None, paper: str | None = None
) -> list[Drawing]:
    """The drawings of a layout: the plan, and the strip if it can be unrolled (see `strip`); a card is flat.

    The strip is cut into bands that fit on the paper in portrait, if one is given.
    """
    if layout.name == TEST_CARD or np.linalg.norm(layout.positions, axis=1).min() < 0.01:
        return [plan(layout)]
    whole = strip(layout, surface_radius_m)
    return [plan(layout), *([whole] if paper is None else bands(whole, *room(paper)))]


def bands(sheet: Drawing, width: float, height: float) -> list[Drawing]:
    """A drawing that is too wide, cut vertically between its circles, with the parts below each other.

    Each cut has one letter on both its sides; parts are about equally wide, and fill drawings of up to the
    width and height, mm.
    """
    if sheet.width <= width:
        return [sheet]
    inner = width - 2 * CUT_MM
    fewest = len(_cuts(sheet, inner))
    narrower = np.linspace(sheet.width / fewest, inner, 40)
    cuts = next(cuts for limit in narrower if len(cuts := _cuts(sheet, float(limit))) <= fewest)
    parts = [_between(sheet, *ends, number) for number, ends in enumerate(pairwise(cuts))]
    many = max(1, int(height // sheet.height))
    return [stacked(parts[at : at + many]) for at in range(0, len(parts), many)]


def _cuts(sheet: Drawing, inner: float) -> list[float]:
    """Where a drawing is cut into parts of up to a width, mm, from edge to edge and between its circles."""
    spots = [(m.centre[0] - SPOT_MM, m.centre[0] + SPOT_MM) for m in sheet.marks if isinstance(m, Circle)]
    cuts = [0.0]
    while cuts[-1] + inner < sheet.width:
        cut = cuts[-1] + inner
        for low, high in sorted(spots, reverse=True):
            if low < cut < high and low > cuts[-1] + inner / 3:
                cut = low
        cuts.append(cut)
    return [*cuts, sheet.width]


def _between(sheet: Drawing, left: float, right: float, number: int) -> Drawing:
    """The part of a drawing between two vertical cuts, with letters at cuts other than its ends."""
    part = Drawing(right - left + 2 * CUT_MM, sheet.height)
    shift = CUT_MM - left
    for mark in sheet.marks:
        if isinstance(mark, Line):
            (x1, y1), (x2, y2) = sorted((mark.start, mark.end))
            if left <= x1 <= right if x1 == x2 else x1 < right and x2 > left:
                held = max(x1, left) + shift, min(x2, right) + shift
                part.add(Line((held[0], y1), (held[1], y2), mark.width, mark.dashed))
        elif left <= (mark.centre if isinstance(mark, Circle) else mark.at)[0] < right:
            part.add(moved(mark, shift, 0.0))
    for x, first in ((left, number - 1), (right, number)):
        if 0 < x < sheet.width:
            letter = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"[first % 26]
            beside = x + shift + (-CUT_MM / 2 if x == left else CUT_MM / 2)
            part.add(Line((x + shift, STRIP_FOOT_MM), (x + shift, sheet.height - 6), 0.15, True))
            part.add(Text((beside, sheet.height / 2 + 8), letter, 5.0))
    return part


def stacked(drawings: list[Drawing]) -> Drawing:
    """Several drawings combined vertically, the first on top."""
    sheet = Drawing(max(d.width for d in drawings), sum(d.height for d in drawings))
    bottom = sheet.height
    for drawing in drawings:
        bottom -= drawing.height
        sheet.add(*(moved(mark, 0.0, bottom) for mark in drawing.marks))
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
    """The middle of the widest gap between angles, deg, to ten degrees: the best place to cut a strip."""
    order = np.sort(angles)
    gap = np.diff(np.append(order, order[0] + 360))
    i = int(np.argmax(gap))
    return int(round((order[i] + gap[i] / 2) / 10) * 10) % 360


def _sides(layout: Layout) -> list[tuple[int, int]]:
    """Pairs of reflectors adjacent around the layout's centre, whose distance is drawn."""
    offset = layout.positions - layout.positions.mean(axis=0)
    order = np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))
    pairs = list(zip(order, np.roll(order, -1), strict=True))
    return [(int(i), int(j)) for i, j in (pairs if layout.size > 2 else pairs[:1])]


def check_bar(sheet: Drawing, at: tuple[float, float]) -> None:
    """The 100 mm scale bar for checking a print, its left end at a point, mm."""
    x, y = at
    sheet.add(Line((x, y), (x + CHECK_MM, y), 0.4), Line((x, y - 2), (x, y + 2)))
    sheet.add(Line((x + CHECK_MM, y - 2), (x + CHECK_MM, y + 2)))
    sheet.add(Text((x + CHECK_MM / 2, y + 3), "100 mm: measure it after printing", 3.0))
