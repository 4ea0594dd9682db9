"""Drawings of layouts: millimetres that are millimetres, on screen and on paper."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from PIL import Image

from tagid.errors import UsageError
from tagid.report.drafting import Circle, Drawing, Line, Text, page_tiles, room, to_png, to_svg
from tagid.report.layout_sheet import bands, in_terminal, overview, plan, stacked, strip, template
from tagid.report.pdf import to_pdf
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = builtin_layouts()


def test_svg_is_true_to_scale() -> None:
    layout = LAYOUTS["helmet-120"]
    root = ElementTree.fromstring(to_svg(plan(layout)).decode())
    width, height = (float(root.attrib[key].removesuffix("mm")) for key in ("width", "height"))
    assert root.attrib["viewBox"] == f"0 0 {width:g} {height:g}"
    circles = root.findall(".//{*}circle")
    spots = np.array(
        [[float(c.attrib["cx"]), -float(c.attrib["cy"])] for c in circles if c.attrib["r"] == "20.000"]
    )
    gap = np.linalg.norm(spots[:, None] - spots[None], axis=2)
    assert np.allclose(gap[~np.eye(3, dtype=bool)], 110 * np.sqrt(3), atol=0.01)
    assert np.allclose(spots - spots.mean(axis=0), layout.positions * 1e3, atol=0.01)  # x right, y up
    assert any("within 1 mm of its mark" in text for text in root.itertext())
    sheet = Drawing(50, 50)
    sheet.add(Text((1, 1), "<script>&"))
    assert b"<script>" not in to_svg(sheet)


def test_pdf_prints_100_mm_as_100_mm() -> None:
    sheet = Drawing(150, 60)
    sheet.add(Line((20, 30), (120, 30), 1.0), Line((20, 20), (20, 40)), Line((120, 20), (120, 40)))
    pdf = to_pdf([sheet], "a4")
    box = [float(v) for v in re.search(rb"/MediaBox \[ ?([\d. ]+)\]", pdf)[1].split()]
    assert box[2:] == pytest.approx([210 / 25.4 * 72, 297 / 25.4 * 72], abs=0.2)
    assert b"\n2.834646 0 0 2.834646 0 0 cm" in pdf  # points per millimetre
    assert b"1 0 0 1 10 227 cm" in pdf  # 10 mm from the left, its 60 mm below 10 mm from the top
    assert b"n 20 30 m 120 30 l S" in pdf


def test_a_sheet_of_all_tags_is_vectors_with_text_to_search() -> None:
    layouts = list(LAYOUTS.values())
    drawings = overview(layouts, *room("a4"))
    for layout in layouts:
        drawings += template(layout, None, "a4")
    pdf = to_pdf(drawings, "a4")
    assert b"/Subtype /Image" not in pdf
    for layout in layouts:
        assert pdf.count(f"({layout.name}) Tj".encode()) == 1, "its picture's name"
        assert f"({layout.name}   {layout.label}".encode() in pdf, "its template"


def test_a_strip_wider_than_paper_is_tiled_without_loss() -> None:
    sheet = strip(LAYOUTS["helmet-120"])
    assert sheet.width == pytest.approx(2 * np.pi * 110 + 20)
    tiles, size = page_tiles(sheet, "a4")
    assert size == (297.0, 210.0) and len(tiles) == 3 and tiles[0][2] == tiles[1][0]
    positions = [m for m in sheet.marks if isinstance(m, Circle)]
    x = np.sort([circle.centre[0] for circle in positions])
    assert np.allclose(np.diff(x), 2 * np.pi * 110 / 3, atol=0.01)
    wrapped = strip(LAYOUTS["helmet-120"], 0.09)
    assert wrapped.width == pytest.approx(2 * np.pi * 90 + 20)
    assert to_pdf([sheet], "a4").count(b"/Type /Page\n") == 3


def test_bands_keep_every_millimetre_and_cut_no_reflector() -> None:
    sheet = strip(LAYOUTS["helmet-120"])
    width, height = room("a4")
    pages = bands(sheet, width, height)
    assert len(pages) == 2 and all(p.width <= width and p.height <= height for p in pages)
    marks = [mark for page in pages for mark in page.marks]
    assert sum(isinstance(m, Circle) for m in marks) == 3
    base = 22.0 + 30.0  # the dashed line that the reflectors sit on, from the foot of its band
    lengths, crossed = [], []
    for page in pages:
        bottoms = [page.height - sheet.height * (i + 1) for i in range(round(page.height / sheet.height))]
        for bottom in bottoms:
            (line,) = (
                m for m in page.marks
                if isinstance(m, Line) and m.dashed and m.start[1] == m.end[1] == pytest.approx(bottom + base)
            )  # fmt: skip
            lengths.append(line.end[0] - line.start[0])
            for circle in (m for m in page.marks if isinstance(m, Circle)):
                if abs(circle.centre[1] - bottom - base) < 1e-6:
                    (x, _), r = circle.centre, circle.radius
                    crossed.append(x - r < line.start[0] or x + r > line.end[0])
    assert sum(lengths) == pytest.approx(2 * np.pi * 110)
    assert min(lengths) > 60, "no part is a remnant"
    assert crossed == [False] * 3
    letters = [m.text for m in marks if isinstance(m, Text) and len(m.text) == 1 and m.text.isalpha()]
    assert sorted(letters) == sorted(2 * [chr(65 + i) for i in range(len(lengths) - 1)])
    assert bands(plan(LAYOUTS["container-90"]), width, height)[0].marks


def test_sheets_with_nothing_on_them_are_not_printed() -> None:
    sheet = Drawing(500, 500)
    sheet.add(Line((1, 499), (499, 499)))
    tiles, size = page_tiles(sheet, "a4")
    assert size == (297.0, 210.0) and len(tiles) == 2 and all(tile[3] == 500 for tile in tiles)
    ring = Drawing(800, 800)
    ring.add(Circle((400, 400), 380))
    inside = [t for t in page_tiles(ring, "a4")[0] if t[0] < 400 < t[2] and t[1] < 400 < t[3]]
    assert not inside


def test_what_cannot_be_unrolled_gets_its_plan_only() -> None:
    assert len(template(LAYOUTS["helmet-linear"])) == 1
    assert len(template(LAYOUTS["container-90"])) == 2
    with pytest.raises(UsageError, match="unrolled"):
        strip(LAYOUTS["helmet-linear"])
    with pytest.raises(UsageError, match="paper"):
        to_pdf([Drawing(10, 10)], "a0")
    with pytest.raises(UsageError, match="surface"):
        strip(LAYOUTS["container-90"], 45.0)


def test_png_carries_its_resolution_and_stacking_keeps_everything() -> None:
    sheets = template(LAYOUTS["container-90"])
    whole = stacked(sheets)
    assert len(whole.marks) == sum(len(s.marks) for s in sheets)
    picture = Image.open(io.BytesIO(to_png(sheets[0])))
    assert picture.width / 200 * 25.4 == pytest.approx(sheets[0].width, abs=0.5)
    assert picture.info["dpi"][0] == pytest.approx(200, abs=0.1)


def test_the_terminal_shows_x_to_the_right_and_y_up() -> None:
    rows = in_terminal(LAYOUTS["container-90"]).split("\n")
    (row1,) = (i for i, row in enumerate(rows) if "1" in row)
    (row2,) = (i for i, row in enumerate(rows) if "2" in row)
    assert row2 < row1 and rows[row1].index("1") > rows[row2].index("2")
