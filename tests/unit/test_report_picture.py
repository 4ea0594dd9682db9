"""Pictures of an image, in files and in the terminal, and the curves of a recording."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SAMPLE_STEP_S
from tagid.errors import DataError, StorageError, UsageError
from tagid.recording.curves import RecordingCurves, slow_time
from tagid.report.axes import Axes, nice_ticks, tick_labels
from tagid.report.canvas import Canvas
from tagid.report.charts import draw_recording, resample_views
from tagid.report.colours import colourise, to_decibels, viridis
from tagid.report.picture import Marker, draw_image, fit_text, thumbnail
from tagid.report.preview import colour_wanted, preview, resample
from tagid.signal import analytic

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


def burst(bins: int, at: float, frequency_hz: float, width_bins: float = 12.0) -> np.ndarray:
    """(bins,) Gaussian burst of unit envelope at a bin."""
    n = np.arange(bins) - at
    return np.exp(-((n / width_bins) ** 2)) * np.cos(2 * np.pi * frequency_hz * SAMPLE_STEP_S * n)


def capture_of(samples: np.ndarray, **more: object) -> Capture:
    return Capture(samples=samples, range_start_m=1.0, range_step_m=RANGE_STEP_M, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("bins", [480, 481])
def test_analytic_signal_of_a_burst_is_its_exponential(bins: int) -> None:
    n = np.arange(bins) - 200
    expected = np.exp(-((n / 12) ** 2) + 0.5j * np.pi * n) * np.array([[1.0], [-3j]]) + np.array([[0.0], [7]])
    samples = expected.real.astype(np.float32)
    np.testing.assert_allclose(analytic(samples), expected, atol=1e-5)
    np.testing.assert_array_equal(analytic(expected.astype(np.complex64)), expected.astype(np.complex64))


def test_a_strong_first_bin_does_not_appear_at_the_far_end() -> None:
    """Circularly, the last bin would stand at -8 dB of an echo that the window's start cuts."""
    envelope = np.abs(analytic(burst(480, 0, 4e9, 3.0)[None]))[0]
    assert 20 * np.log10(envelope[-60:].max() / envelope.max()) < -40
    assert envelope[0] == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("frequency_hz", [3.2e9, 4.0e9, 4.7e9])
@pytest.mark.parametrize("complex_samples", [False, True])
def test_spectrum_peaks_at_the_true_frequency(frequency_hz: float, complex_samples: bool) -> None:
    samples = np.tile(burst(960, 400, frequency_hz, 30), (3, 1))
    data = analytic(samples) if complex_samples else samples.astype(np.float32)
    curves = RecordingCurves.of(capture_of(data))
    result = curves.frequency_hz[curves.spectrum.argmax()]
    assert result == pytest.approx(frequency_hz, abs=1.1 / (960 * SAMPLE_STEP_S))


def test_envelopes_give_height_and_range() -> None:
    scans = np.stack([a * burst(480, 200, 4e9) for a in (100.0, 200.0, 600.0)]).astype(np.float32)
    curves = RecordingCurves.of(capture_of(scans))
    assert curves.range_m[curves.mean_envelope.argmax()] == pytest.approx(1.0 + 200 * RANGE_STEP_M)
    assert curves.mean_envelope.max() == pytest.approx(300, rel=0.01)
    assert curves.max_envelope.max() == pytest.approx(600, rel=0.01)


def test_slow_time_takes_the_best_clock() -> None:
    samples = np.ones((3, 8), np.float32)
    radar, host = np.array([5.0, 26.0, 48.0]), np.array([1, 2, 4], np.int64) * 10**9
    both = capture_of(samples, radar_time_ms=radar, host_time_ns=host)
    np.testing.assert_allclose(slow_time(both)[0], [0, 0.021, 0.043])
    np.testing.assert_allclose(slow_time(replace(both, radar_time_ms=radar[::-1].copy()))[0], [0, 1, 3])
    position, label = slow_time(capture_of(samples))
    assert (position.tolist(), label) == ([0, 1, 2], "view")


def test_reduction_keeps_a_flash_and_shows_a_gap() -> None:
    envelope = np.ones((1000, 400), np.float32)
    envelope[333, 123] = 50
    position = np.arange(1000.0)
    position[500:] += 200
    picture, gaps = resample_views(envelope, position, rows=120, columns=40)
    assert picture.shape == (120, 40)
    assert picture[333 // 10, 12] == 50
    assert np.count_nonzero(picture > 1) == 1
    assert gaps.nonzero()[0].tolist() == list(range(50, 70))
    picture, gaps = resample_views(np.array([[1, 2], [3, 4]], np.float32), np.array([0.0, 1.0]), 10, 30)
    assert picture.tolist() == [[1, 2]] * 5 + [[3, 4]] * 5 and not gaps.any(), "few views are stretched"


def test_the_sinogram_shows_a_return_at_its_range(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    scans = 1000 * burst(576, 432, 4e9) + rng.normal(0, 5, (40, 576))
    draw_recording(capture_of(scans.astype(np.float32)), tmp_path / "show.png", "a scan")
    with Image.open(tmp_path / "show.png") as picture:
        assert picture.size == (1000, 1330)
        colours = np.asarray(picture.convert("RGB")).astype(int)
    row = colours[680, 120:880]  # through the middle of the sinogram
    brightest = np.abs(row - (253, 231, 37)).sum(axis=1) < 30
    assert brightest.nonzero()[0].mean() == pytest.approx((432 + 0.5) / 576 * 760, abs=3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (5, 1), (2, 2)])
@pytest.mark.parametrize("dtype", [np.int32, np.complex64])
def test_degenerate_recordings_are_drawn(tmp_path: Path, shape: tuple[int, int], dtype: type) -> None:
    for fill in (0, 7):
        draw_recording(capture_of(np.full(shape, fill, dtype)), tmp_path / "show.png")
    same_time = capture_of(np.ones((3, 4), np.int32), radar_time_ms=np.array([0.0, 0.0, 9.0]))
    draw_recording(same_time, tmp_path / "show.png")
    assert (tmp_path / "show.png").stat().st_size > 1000


def test_what_rests_disappears_from_the_changing_part() -> None:
    turning = np.stack([100 * burst(480, 300 + 5 * np.sin(2 * np.pi * v / 40), 4e9) for v in range(40)])
    capture = capture_of((5000 * burst(480, 100, 4e9) + turning).astype(np.float32))
    curves = RecordingCurves.of(capture, changing_only=True)
    assert curves.mean_envelope.argmax() == 100
    assert curves.changing_envelope[:200].max() < 1
    assert abs(int(curves.changing_envelope.argmax()) - 300) < 12
    assert curves.envelope[:, :200].max() < 1
    assert curves.envelope[:, 200:].max() > 100


def test_the_spectrum_of_a_longer_recording_is_no_larger() -> None:
    samples = burst(480, 200, 4e9)[None].astype(np.float32)
    short, long = (RecordingCurves.of(capture_of(np.tile(samples, (n, 1)))).spectrum for n in (3, 300))
    np.testing.assert_allclose(long, short, rtol=1e-5, atol=1e-5 * short.max())
