"""A transmitting and a receiving antenna side by side: exact paths from the scan to the answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.enrolling.field import MatchedField
from tagid.errors import DataError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import FitSettings
from tagid.imaging.backprojection import backproject, upsample_at_carrier
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.region import choose_region
from tagid.pipeline.prepared import load_capture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.views import fold_views
from tagid.simulate import Acquisition, scene_from_name, simulate_capture
from tagid.storage.importers import read_any
from tests.unit.imaging_scenes import record, turn
from train.metrics import pick_peaks

GOLDEN = Path(__file__).parents[1] / "data" / "captures"
APART_M = 0.2
POINTS = np.array([[0.11, -0.04], [-0.05, 0.12], [-0.09, -0.08]])
PLAIN = PreprocessSettings("none", False, extent_m=0.4)


def in_the_room(angle: float, height: float, points: np.ndarray) -> np.ndarray:
    """Half the way from (1, d, h) over points turned by the angle to (1, -d, h), written out in the room."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    ways = [np.sqrt((x - 1) ** 2 + (y - d) ** 2 + height**2) for d in (APART_M / 2, -APART_M / 2)]
    return (ways[0] + ways[1]) / 2


def test_ranges_are_half_the_way_over_the_point() -> None:
    angles = np.array([0.0, 0.4, 2.1, 4.4])
    aperture = Aperture.turntable(angles, 1.0, 0.3, APART_M)
    expected = np.array([in_the_room(a, 0.3, POINTS) for a in angles])
    np.testing.assert_allclose(aperture.distances(POINTS), expected, rtol=1e-12)
    near, far = aperture.span(0.2)
    assert (near <= expected.min(axis=1)).all()
    assert (far >= expected.max(axis=1)).all()
    moved = aperture.with_axis_distance(1.1)
    assert moved.separation == pytest.approx(APART_M)
    first, other = moved.antennas
    np.testing.assert_allclose(np.linalg.norm(first - other, axis=1), APART_M)
    free = Aperture.two_antennas(*aperture.antennas)
    np.testing.assert_allclose(free.distances(POINTS), expected, rtol=1e-12)
    assert len(aperture.select(slice(1, 3)).antennas[1]) == 2
    with pytest.raises(DataError):
        Aperture(np.ones((3, 3)), half_baseline=np.ones((2, 3)))


def test_scans_of_the_operator_are_those_of_the_exact_paths() -> None:
    """Through the whole preprocessing; the ranges of the scans are those of the room, tested above."""
    scans = preprocess(record(POINTS, [1, 1, 1], turn(24, 1.0, 0.3, APART_M), start_m=0.4), settings=PLAIN)
    model = ForwardOperator(scans, POINTS).forward(np.ones(3))
    assert np.abs(model - scans.samples).max() < 0.01 * np.abs(scans.samples).max()
    alone = scans.with_aperture(turn(24, 1.0, 0.3))
    wrong = ForwardOperator(alone, POINTS).forward(np.ones(3))
    assert np.abs(wrong - scans.samples).max() > 0.3 * np.abs(scans.samples).max()


def test_every_engine_of_the_fit_takes_both_antennas() -> None:
    scans = preprocess(record(POINTS, [1, 1, 1], turn(36, apart=APART_M), noise=0.02), settings=PLAIN)
    grid, settings = ImageGrid(0.4, 56), FitSettings(held_out=0.1)
    pair, alone = (fit(s, grid, settings).held_out for s in (scans, scans.with_aperture(turn(36))))
    assert pair < 0.1
    assert alone > 2 * pair


def errors_mm(views: Aperture, assumed: Aperture) -> np.ndarray:
    """How far the backprojected peak of each point alone lies from it, mm, under an assumed aperture."""
    axis = np.arange(-0.012, 0.0121, 0.0005)
    around = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], axis=1)
    errors = []
    for point in POINTS:
        scans = preprocess(record([point], [1], views), settings=replace(PLAIN, matched_filter=True))
        rows, start, step = upsample_at_carrier(scans, slice(None))
        place = RangeGeometry.of(assumed, around + point, (start, step), rows.shape[1])
        errors.append(1e3 * np.hypot(*around[np.argmax(np.abs(place.gather(rows)))]))
    return np.array(errors)


def test_ignoring_the_second_antenna_costs_millimetres() -> None:
    """0.2 m apart and 1 m away every range is 5 mm longer: a quarter turn moves points by 3 mm."""
    angles = np.deg2rad(np.arange(-45, 45, 1.5))
    pair, single = Aperture.turntable(angles, 1.0, 0.0, APART_M), Aperture.turntable(angles, 1.0)
    assert pair.distances(np.zeros((1, 2))) == pytest.approx(np.hypot(1, 0.1))
    assert errors_mm(pair, pair).max() < 1.2
    assert errors_mm(pair, single).min() > 2
    whole = turn(120, apart=APART_M)
    assert errors_mm(whole, whole).max() < 0.3
    assert errors_mm(whole, turn(120)).max() > 0.4


def test_a_path_of_pairs_is_imaged_where_the_echoes_are() -> None:
    single = np.column_stack([np.linspace(-1.2, 1.2, 160), np.zeros((160, 2))])
    pairs = Aperture.two_antennas(single, single + np.array([0.3, 0.0, 0.1]))
    capture = record([[0.3, 1.8]], [1.0], pairs, start_m=0.0, bins=500)
    region = choose_region(capture, ImageGrid(0.5, 64), None, 0.0, "none", free_extent=True, free_pixels=True)
    assert np.hypot(region.points[0].x_m - 0.3, region.points[0].y_m - 1.8) < 0.02
    scans = preprocess(region.capture, settings=PreprocessSettings("none", True, extent_m=region.grid.extent))
    place = pick_peaks(backproject(scans, region.grid), 1)[0] + np.array(region.centre_m)
    assert np.hypot(*(place - [0.3, 1.8])) < 0.01


def test_reader_and_simulator_know_both_antennas() -> None:
    acquisition = Acquisition(views=72, antenna_separation_m=APART_M, antenna_height_m=0.2, snr_db=30)
    capture, truth = simulate_capture(scene_from_name("points-3", 1), acquisition, 1)
    assert capture.antenna_separation_m == APART_M
    scans = preprocess(capture, settings=PLAIN)
    field = MatchedField(fold_views(scans, 0.15), 0.15)
    aperture = capture.aperture()
    np.testing.assert_allclose(
        MatchedField(scans, 0.15).distances(POINTS), aperture.distances(POINTS).T, rtol=1e-12
    )
    positions = truth.positions_m
    around = positions[:, None] + 0.01 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    strength = np.abs(field.correlate(field.templates(around)))
    assert (strength[:, 0] > strength[:, 1:].max(axis=1)).all()
    # Three unit points explain what the simulator made, to the carrier's phase.
    model = ForwardOperator(scans, positions).forward(truth.amplitudes)
    data = scans.samples - scans.samples.mean(axis=0)
    remaining = data - (model - model.mean(axis=0))
    assert np.vdot(remaining, remaining).real < 0.1 * np.vdot(data, data).real


def test_files_keep_both_antennas_and_one_of_the_present_format_is_kept() -> None:
    capture = read_any(GOLDEN / "version-3-antennas.tagid.h5")
    assert capture.antenna_separation_m == APART_M
    assert capture.aperture().separation == pytest.approx(APART_M)
    pairs = read_any(GOLDEN / "version-3-positions.tagid.h5")
    assert pairs.receive_positions_m is not None
    np.testing.assert_allclose(pairs.aperture().distances(POINTS), capture.aperture().distances(POINTS))


def test_the_command_line_says_how_far_the_antennas_are_apart(tagid, tmp_path: Path) -> None:
    made = tagid("simulate", "points-3", "--views", 36, "--antenna-separation", 0.2, "--out", "two.tagid.h5")
    assert made.code == 0, made.err
    assert read_any(tmp_path / "two.tagid.h5").antenna_separation_m == 0.2
    words = ("--method", "sparse", "--no-focus", "--antenna-separation", 0, "--output", "json")
    wrong = tagid("reconstruct", "two.tagid.h5", *words)
    assert wrong.code == 0, wrong.err
    settings = ImagingSettings(method="sparse", focus_m=0.0)
    right = reconstruct(load_capture(tmp_path / "two.tagid.h5"), settings)
    left = wrong.json["data"]["settings"]["held_out"]["residual"]
    assert right.image.settings["held_out"]["residual"] < 0.85 * left
