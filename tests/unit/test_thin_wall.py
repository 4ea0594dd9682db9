"""The echo of a thin round wall below a tag: what it is told by, and what must not be taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import response, synthetic_scans

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import ReaderSettings, read_tag
from tagid.tags.matching.vote import read_together
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import Fit, search
from tagid.tags.reading.thin_wall import thin_wall
from tagid.tags.reading.uneven import UnevenFit
from train.population import draw

LAYOUTS = list(builtin_layouts().values())
LAYOUT = builtin_layouts()["container-90"]
CENTRE = np.array([0.006, -0.004])
NOISE = 0.8
TAG = LAYOUT.placed(1.0, CENTRE)[:, :2]


def with_wall(scans: BasebandScans, radius_m: float, amplitude: complex) -> BasebandScans:
    """The scans and the flash of a round wall about CENTRE, by its definition."""
    d = np.hypot(*(scans.aperture.positions[:, :2] - CENTRE).T) - radius_m
    k = scans.wavenumber
    echo = response()(scans.ranges_m[None] - d[:, None]) * np.exp(-2j * k * d[:, None])
    return replace(scans, samples=(scans.samples + amplitude * echo).astype(np.complex64))


def best_fit(scans: BasebandScans) -> tuple[MatchedField, Fit]:
    field = MatchedField(scans, 0.18)
    return field, min(search(field, LAYOUTS, ReaderSettings().search), key=lambda fit: fit.criterion)


@pytest.mark.parametrize("radius_m", [0.016, 0.04])
def test_the_wall_is_found_and_taken_out(radius_m: float) -> None:
    tag = synthetic_scans(TAG, noise=0.1, seed=2)
    scans = with_wall(tag, radius_m, 0.5j)
    wall = thin_wall(scans, *best_fit(scans))
    assert wall is not None
    assert wall.radius_m == pytest.approx(radius_m, abs=0.008)
    assert wall.strength == pytest.approx(0.5, abs=0.1)

    def moving(samples: np.ndarray) -> np.ndarray:
        return samples - samples.mean(axis=0)

    left = moving(wall.scans.samples - tag.samples)
    assert np.sum(np.abs(left) ** 2) < 0.05 * np.sum(np.abs(moving(scans.samples - tag.samples)) ** 2)


def test_a_tag_before_a_thin_wall_is_named() -> None:
    """Without it the flash counts as a reflector elsewhere."""
    named = noted = 0
    for seed in range(8):
        scans = with_wall(synthetic_scans(TAG, noise=0.5, seed=seed), 0.025, 0.55)
        reading = read_tag(scans, LAYOUTS)
        named += (reading.status, reading.layout) == ("identified", "container-90")
        noted += "thin round wall" in reading.note
        if reading.note:
            assert reading.hypotheses[0].layout == "container-90" and reading.bound is not None
    assert named == 8 and noted >= 3


@pytest.mark.parametrize("snr_db", [5.0, 10.0])
def test_a_pair_on_a_can_is_no_row_before_a_thin_wall(snr_db: float) -> None:
    """At 12 views three reflectors and a wave that was taken out left a sixth of the echo."""
    capture = draw(90163, tagged=True, views=12, snr_db=snr_db).capture
    scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    assert read_tag(scans, LAYOUTS).layout in (None, "container-180")


def test_a_vote_of_such_recordings_names_it_too() -> None:
    """What hides the name in each recording hides it in all of them."""
    recordings = [with_wall(synthetic_scans(TAG, noise=0.5, seed=s), 0.025, 0.55) for s in (1, 3, 7)]
    joint, alone = read_together(recordings, LAYOUTS)
    assert all(one.wall_m is not None for one in alone)
    assert (joint.status, joint.layout) == ("identified", "container-90")


def test_a_reflector_in_the_centre_is_no_wall() -> None:
    """A wave about the centre is what it sends, too: such a tag is another one."""
    points = np.concatenate([TAG, CENTRE[None]])
    for seed in range(4):
        scans = synthetic_scans(points, noise=NOISE, seed=seed)
        assert thin_wall(scans, *best_fit(scans)) is None
        assert read_tag(scans, LAYOUTS).status != "identified"


@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_the_flash_of_a_wall_is_no_reflector_in_the_middle(noise: float) -> None:
    """The outer two of `helmet-linear` before a wall whose wave is that of a third of a reflector."""
    places = builtin_layouts()["helmet-linear"].placed(0.4, CENTRE)[:, :2]
    outer = places[np.hypot(*(places - CENTRE).T) > 0.05]
    assert len(outer) == 2
    for seed in range(3):
        two = with_wall(synthetic_scans(outer, noise=noise, seed=seed), 0.07, 0.5)
        assert read_tag(two, LAYOUTS).status != "identified"
        three = with_wall(synthetic_scans(places, noise=noise, seed=seed), 0.07, 0.5)
        reading = read_tag(three, LAYOUTS)
        assert (reading.status, reading.layout) == ("identified", "helmet-linear"), reading.reason


def test_a_tag_with_one_reflector_more_is_not_named_for_a_wall() -> None:
    for angle in (0.3, 2.0, 4.1):
        more = CENTRE + 0.06 * np.array([np.cos(angle), np.sin(angle)])
        scans = synthetic_scans(np.concatenate([TAG, more[None]]), noise=NOISE, seed=5)
        assert read_tag(scans, LAYOUTS).status != "identified"


def test_a_reflector_on_the_axis_is_no_stronger_for_being_seen_from_all_sides() -> None:
    """Amplitudes that differ by the side that is seen are compared where it faces the antenna."""
    layout = builtin_layouts()["helmet-linear"]
    centre = np.array([0.008, 0.003])
    places = layout.placed(0.4, centre)[:, :2]
    whole = synthetic_scans(places[:0])
    samples = whole.samples.astype(complex)
    k, angles = whole.wavenumber, np.arctan2(*whole.aperture.positions[:, 1::-1].T)
    for place in places:
        d = np.hypot(*(whole.aperture.positions[:, :2] - place).T)
        x, y = place - centre
        side = np.cos(angles - np.arctan2(y, x)) if np.hypot(x, y) > 0.01 else 1.0
        seen = 0.7 + 0.3 * ((1 + side) / 2) ** 3
        samples += (
            np.broadcast_to(seen, d.shape)[:, None]
            * response()(whole.ranges_m[None] - d[:, None])
            * np.exp(-2j * k * d[:, None])
        )
    scans = replace(whole, samples=samples.astype(np.complex64))
    field = MatchedField(scans, 0.18)
    fit = next(f for f in search(field, LAYOUTS, ReaderSettings().search) if f.layout.name == layout.name)
    sizes = UnevenFit.of(field, fit, 1e-3).sizes
    assert sizes.min() > 0.98 * sizes.max()


def test_a_hidden_sector_takes_no_name_away() -> None:
    """A cable or a hand hides all reflectors over 120 degrees: they are alike, and no points elsewhere."""
    named = 0
    for seed, toward in enumerate((0.3, 1.6, 2.9, 4.2)):
        scans = synthetic_scans(
            builtin_layouts()["helmet-120"].placed(1.0, CENTRE)[:, :2], noise=0.25, seed=seed
        )
        angles = np.arctan2(*scans.aperture.positions[:, 1::-1].T)
        quiet = synthetic_scans(TAG[:0], noise=0.25, seed=seed + 50)
        hidden = np.cos(angles - toward) > 0.5
        samples = np.where(hidden[:, None], quiet.samples, scans.samples)
        reading = read_tag(replace(scans, samples=samples), LAYOUTS)
        named += (reading.status, reading.layout) == ("identified", "helmet-120")
    assert named == 4


def test_two_reflectors_on_a_box_are_no_right_angle_before_a_thin_wall() -> None:
    """Points elsewhere explained more, and the layout left two thirds of the echo."""
    scans = preprocess(draw(4018822).capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    assert read_tag(scans, LAYOUTS).status == "unknown"
