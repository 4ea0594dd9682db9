"""The image in the terminal: same way up as the picture, with and without colour."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from tagid.errors import DataError, UsageError
from tagid.report.preview import colour_wanted, preview, resample


def point(row: int, column: int, pixels: int = 100) -> np.ndarray:
    values = np.zeros((pixels, pixels), np.complex64)
    values[row, column] = 2 - 1j
    return values


def test_characters_show_the_point_in_its_corner() -> None:
    lines = preview(point(93, 5), 0.5, width=48, colour=False).plain.splitlines()
    picture = lines[:-2]
    assert len(picture) == 20  # 40 columns of a square image, cells twice as high as wide
    assert [(r, line.index("@")) for r, line in enumerate(picture) if "@" in line] == [(1, 8 + 2)]
    assert picture[0].startswith("+0.25 m")
    assert picture[-1].startswith("-0.25 m")
    assert lines[-2].split() == ["-0.25", "m", "+0.25", "m"]
    assert "-30 dB" in lines[-1]


def test_a_single_pixel_survives_every_reduction() -> None:
    for row in range(0, 97, 7):
        text = preview(point(row, 96 - row, 97), 0.5, width=30, colour=False).plain
        assert "@" in text.rsplit("\n", 1)[0]


def test_half_blocks_colour_upper_and_lower_pixel_on_their_own() -> None:
    values = np.zeros((40, 40))
    values[39, 0] = 1.0  # top left: the upper half of the first cell
    text = preview(values, 0.5, width=48, colour=True)
    start = text.plain.index("▀")
    style = next(str(s.style) for s in text.spans if s.start <= start < s.end)
    assert style == "#fde725 on #440154"


def render(*, colour: bool, no_color: bool) -> str:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, color_system="truecolor", no_color=no_color, width=80)
    console.print(preview(point(50, 50), 0.5, width=40, colour=colour))
    return stream.getvalue()


def test_ansi_colours_only_where_wanted() -> None:
    assert "\x1b[38;2;" in render(colour=True, no_color=False)
    assert "\x1b[" not in render(colour=False, no_color=True)


def test_a_console_without_colours_gets_characters() -> None:
    def console(**options: object) -> Console:
        return Console(file=io.TextIOWrapper(io.BytesIO(), "utf-8"), legacy_windows=False, **options)  # type: ignore[arg-type]

    assert colour_wanted(console(force_terminal=True, color_system="256", no_color=False))
    assert not colour_wanted(console(force_terminal=True, color_system="256", no_color=True))
    assert not colour_wanted(console(force_terminal=False, no_color=False))
    latin = Console(file=io.TextIOWrapper(io.BytesIO(), "latin-1"), force_terminal=True, color_system="256")
    assert not colour_wanted(latin)


def test_resample_takes_the_largest_and_repeats_upwards() -> None:
    values = np.array([[1.0, 5.0, 2.0], [0.0, 0.0, 7.0]])
    assert resample(values, 1, 1).tolist() == [[7.0]]
    assert resample(values, 4, 3)[:2].tolist() == [[1.0, 5.0, 2.0], [1.0, 5.0, 2.0]]
    assert resample(values, 2, 3).tolist() == values.tolist()


def test_no_line_is_wider_than_asked() -> None:
    for extent in (0.05, 0.5, 12.0):
        for width in (16, 60, 121):
            lines = preview(np.ones((30, 20)), extent, width=width, colour=False).plain.splitlines()
            # The last line is the scale, as wide as its numbers need.
            assert max(len(line) for line in lines[:-1]) <= max(width, 24)


def test_nonsense_is_refused() -> None:
    with pytest.raises(UsageError):
        preview(np.ones((3, 3)), 0.5, width=3, colour=False)
    with pytest.raises(DataError):
        preview(np.full((3, 3), np.inf), 0.5, colour=False)
