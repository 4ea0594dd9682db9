"""The picture of an image: right side up, in metres and dB, and never half-written."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from tagid.errors import DataError, DiskFullError, StorageError, UsageError
from tagid.report.axes import Axes, nice_ticks, tick_labels
from tagid.report.canvas import Canvas
from tagid.report.colours import colourise, to_decibels, viridis
from tagid.report.picture import Marker, draw_image, fit_text, thumbnail

LEFT, TOP, SIDE = 110, 100, 700  # the frame of draw_image, px


def pixel(path: Path, x_m: float, y_m: float, extent_m: float) -> np.ndarray:
    """The colour that the picture shows at a point given in metres."""
    with Image.open(path) as picture:
        at = (round(LEFT + (x_m / extent_m + 0.5) * SIDE), round(TOP + (0.5 - y_m / extent_m) * SIDE))
        return np.array(picture.convert("RGB").getpixel(at), dtype=int)


def point_image(row: int, column: int, pixels: int = 50) -> np.ndarray:
    values = np.full((pixels, pixels), 1e-4, dtype=np.complex64)
    values[row, column] = 1j
    return values


def test_a_thumbnail_is_the_image_alone(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    draw_image(point_image(row=40, column=10), 0.5, path, title="x" * 40)
    small = thumbnail(path.read_bytes(), 50)
    with Image.open(io.BytesIO(small)) as picture:
        pixels = np.array(picture.convert("L"))
    assert pixels.shape == (50, 50) and len(small) < 5000
    assert np.unravel_index(pixels.argmax(), pixels.shape) == (9, 10), "y is up"
    assert pixels[:, 30:].max() < 60, "no letters, axes or colour bar"
    for wrong in (b"", b"no picture", small, small[:100]):
        with pytest.raises(DataError):
            thumbnail(wrong)


def test_positive_y_is_up_and_positive_x_is_right(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    draw_image(point_image(row=40, column=10), 0.5, path)  # y = (40.5 / 50 - 0.5) * 0.5 = +0.155, x = -0.145
    yellow, violet = viridis()[-1].astype(int), viridis()[0].astype(int)
    assert np.abs(pixel(path, -0.145, 0.155, 0.5) - yellow).max() <= 2
    for x, y in ((-0.145, -0.155), (0.145, 0.155), (0.145, -0.155)):
        assert np.abs(pixel(path, x, y, 0.5) - violet).max() <= 2


def test_colour_tells_the_decibels(tmp_path: Path) -> None:
    values = np.full((20, 20), 0.1)  # -20 dB of the brightest pixel
    values[0, 0] = 1.0
    draw_image(values, 1.0, tmp_path / "image.png", dynamic_range_db=40)
    middle = viridis()[round(0.5 * 255)].astype(int)
    assert np.abs(pixel(tmp_path / "image.png", 0.025, 0.025, 1.0) - middle).max() <= 3


def test_markers_show_at_their_place_only_inside(tmp_path: Path) -> None:
    plain, marked = tmp_path / "plain.png", tmp_path / "marked.png"
    values = point_image(25, 25)
    draw_image(values, 0.5, plain)
    draw_image(values, 0.5, marked, reflectors=[Marker(0.1, -0.1, "1"), Marker(-0.2, 0.2, "extra", False)])
    with Image.open(plain) as a, Image.open(marked) as b:
        rows, columns = np.nonzero((np.asarray(a) != np.asarray(b)).any(axis=2))
    assert np.abs(rows - (TOP + 0.7 * SIDE)).min() < 25
    assert np.abs(columns - (LEFT + 0.7 * SIDE)).min() < 25
    near_first = np.hypot(columns - (LEFT + 0.7 * SIDE), rows - (TOP + 0.7 * SIDE)) < 60
    near_second = np.hypot(columns - (LEFT + 0.1 * SIDE), rows - (TOP + 0.1 * SIDE)) < 110
    legend = (rows > TOP - 32) & (rows < TOP - 4)
    assert (near_first | near_second | legend).all()
    assert near_first.any()
    assert near_second.any()
    # A circle and a cross, each with its meaning.
    assert legend.any() and columns[legend].max() > LEFT + 300
    draw_image(values, 0.5, marked, reflectors=[Marker(0.1, -0.1, "1")])
    with Image.open(plain) as a, Image.open(marked) as b:
        single = np.nonzero((np.asarray(a) != np.asarray(b))[TOP - 32 : TOP - 4].any(axis=2))[1]
    assert single.min() >= LEFT and single.max() < LEFT + 300
    outside = tmp_path / "outside.png"
    draw_image(values, 0.5, outside, reflectors=[Marker(0.4, 0.0, "far")])
    assert outside.read_bytes() == plain.read_bytes()


def test_wide_images_keep_their_pixels_square(tmp_path: Path) -> None:
    draw_image(np.ones((10, 40)), 1.0, tmp_path / "wide.png")
    with Image.open(tmp_path / "wide.png") as picture:
        colours = np.asarray(picture.convert("RGB"))
    yellow = (np.abs(colours[:, LEFT + 350].astype(int) - viridis()[-1]).max(axis=1) <= 2).sum()
    assert abs(yellow - SIDE / 4) <= 6


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (200, 3)])
def test_odd_shapes_and_all_zero_images_are_drawn(tmp_path: Path, shape: tuple[int, int]) -> None:
    draw_image(np.zeros(shape, np.complex64), 0.5, tmp_path / "zero.png", title="x" * 1000)
    with Image.open(tmp_path / "zero.png") as picture:
        assert picture.size == (940, 900)


@pytest.mark.parametrize(
    ("values", "extent", "depth", "error"),
    [
        (np.zeros((0, 3)), 0.5, 30.0, DataError),
        (np.zeros(4), 0.5, 30.0, DataError),
        (np.full((3, 3), np.nan), 0.5, 30.0, DataError),
        (np.ones((3, 3)), 0.0, 30.0, UsageError),
        (np.ones((3, 3)), np.inf, 30.0, UsageError),
        (np.ones((3, 3)), 0.5, -1.0, UsageError),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_a_file_exists(
    tmp_path: Path, values: np.ndarray, extent: float, depth: float, error: type[Exception]
) -> None:
    with pytest.raises(error):
        draw_image(values, extent, tmp_path / "never.png", dynamic_range_db=depth)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(StorageError) as caught:
        draw_image(np.ones((3, 3)), 0.5, tmp_path / "missing" / "image.png")
    assert "missing" in caught.value.message
    assert caught.value.remedy


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full to meet a full disk")
def test_a_full_disk_leaves_the_old_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "image.png"
    draw_image(np.ones((3, 3)), 0.5, path)
    before = path.read_bytes()

    def write_to_full_disk(_: int, data: memoryview) -> int:
        with Path("/dev/full").open("wb", buffering=0) as full:
            return full.write(data)

    monkeypatch.setattr("os.write", write_to_full_disk)
    with pytest.raises(DiskFullError):
        draw_image(np.eye(3), 0.5, path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["image.png"]


def lightness(rgb: np.ndarray) -> np.ndarray:
    """CIE L* (0..100) of sRGB colours (..., 3), after IEC 61966-2-1 and CIE 15."""
    linear = np.asarray(rgb, dtype=np.float64) / 255
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722])
    curve = np.where(luminance > 216 / 24389, np.cbrt(luminance), luminance * 24389 / 27 / 116 + 16 / 116)
    return np.asarray(116 * curve - 16)


def test_lightness_rises_over_the_whole_colour_table() -> None:
    steps = np.diff(lightness(viridis(64)))
    assert steps.min() > 0
    assert steps.max() < 2.5 * steps.mean()  # no jump that would look like an edge


def test_decibels_are_clipped_at_both_ends() -> None:
    assert to_decibels(np.array([2.0, 1.0, 0.1, 0.0]), 30, reference=1.0).tolist() == [0, 0, -20, -30]
    assert to_decibels(np.zeros(2), 30).tolist() == [-30, -30]
    assert colourise(np.array([-99.0, 5.0]), 30).tolist() == viridis()[[0, -1]].tolist()


@given(low=st.floats(-1e4, 1e4), span=st.floats(1e-3, 1e4), count=st.integers(3, 8))
@example(low=1.125, span=0.0625, count=3)  # one tick alone says nothing of a spacing
def test_ticks_are_few_round_inside_and_differ(low: float, span: float, count: int) -> None:
    ticks = nice_ticks(low, low + span, count)
    assert 1 <= len(ticks) <= count + 1
    assert all(low - 1e-6 * span <= t <= low + span * (1 + 1e-6) for t in ticks)
    labels = tick_labels(ticks)
    assert len(set(labels)) == len(labels)
    for label, tick in zip(labels, ticks, strict=True):
        assert float(label) == pytest.approx(tick, abs=1e-3 * span)


def test_axes_place_limits_on_the_frame() -> None:
    axes = Axes(Canvas(200, 100), (20, 10, 180, 90), (-1.0, 3.0), (0.0, 5.0))
    assert axes.place(-1.0, 0.0) == (20, 90)
    assert axes.place(3.0, 5.0) == (180, 10)
    assert axes.place(1.0, 2.5) == (100, 50)


def test_long_titles_are_cut_to_the_width() -> None:
    canvas = Canvas(300, 50)
    cut = fit_text(canvas, "a long title\nover " * 20, 200, 22)
    assert cut.endswith("…")
    assert canvas.text_width(cut, 22) <= 200
    assert fit_text(canvas, "short", 200, 22) == "short"
