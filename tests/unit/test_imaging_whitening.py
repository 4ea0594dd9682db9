"""Coloured noise: its density over the band is estimated and the scans are filtered by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.imaging.whitening import whitened
from tagid.reading.decision import decide
from tagid.reading.reader import contest
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.shade import SHADES
from tagid.reading.transfers.wall import WALLS
from tagid.simulate import Acquisition, NoiseShape, Placement, parse_body, simulate_capture
from tagid.simulate.noise import Interference
from tagid.simulate.objects import object_scene
from tagid.simulate.specification import ReflectorSpec
from tagid.tags.layouts.layout import builtin_layouts

SETTINGS = PreprocessSettings(matched_filter=False, extent_m=0.5)
LAYOUTS = builtin_layouts()


def scans_of(noise: NoiseShape, snr_db: float = 10.0, seed: int = 0, body: str = "none") -> BasebandScans:
    """A turn of 36 views of container-90 with 20 mm octahedra, 6 mm off the axis."""
    positions, rng = LAYOUTS["container-90"].positions, np.random.default_rng(seed)
    scene = object_scene("tagged", positions, parse_body(body), ReflectorSpec("octahedron", 0.020), rng=rng)
    acquisition = Acquisition(views=36, snr_db=snr_db, noise=noise, placement=Placement((0.006, 0.0), 0.7))
    return preprocess(simulate_capture(scene, acquisition, seed)[0], settings=SETTINGS)


def test_white_noise_has_no_shape_and_changes_nothing() -> None:
    scans = scans_of(NoiseShape())
    assert scans.noise_shape == () and whitened(scans) is scans


def test_the_shape_of_coloured_noise_has_its_maximum_in_the_middle_of_the_band() -> None:
    shapes = np.array([scans_of(NoiseShape(1.0), seed=seed).noise_shape for seed in range(4)]).mean(axis=0)
    middle, edges = shapes[len(shapes) // 2], (shapes[0] + shapes[-1]) / 2
    assert middle > 5 * edges


def test_a_transmitter_in_the_band_shows_at_its_frequency() -> None:
    """Its sign counts: a mirrored frequency axis would weaken the wrong end of the band."""
    low = np.array(scans_of(NoiseShape(0.0, Interference(6.0, 3.4e9))).noise_shape)
    high = np.array(scans_of(NoiseShape(0.0, Interference(6.0, 4.5e9))).noise_shape)
    third = len(low) // 3
    assert int(np.argmax(low)) < third and int(np.argmax(high)) > 2 * third


def test_whitened_noise_has_one_density_and_echoes_keep_their_model() -> None:
    """Noise alone is flat behind the filter, and a noiseless point is still sigma response(R - d)."""
    noisy = scans_of(NoiseShape(1.0), snr_db=-30.0)
    clean = replace(scans_of(NoiseShape(1.0), snr_db=90.0), noise_shape=noisy.noise_shape)
    flat = whitened(noisy)
    bins = flat.samples.shape[1]
    offsets = np.linspace(-0.45, 0.45, 9) * flat.independent_samples / flat.samples.size
    window = np.hanning(bins + 2)[1:-1]
    kernel = np.exp(-2j * np.pi * np.arange(bins)[:, None] * offsets) * window[:, None]
    before, after = (np.mean(np.abs(s.samples @ kernel) ** 2, axis=0) for s in (noisy, flat))
    # Nine bins before the object resolve a third of the band: sharper edges remain.
    assert before.max() / before.min() > 4 * after.max() / after.min()
    assert after.mean() / flat.noise_density / (window**2).sum() == pytest.approx(1.0, abs=0.3)

    filtered = whitened(clean)
    distance = 0.97
    point = clean.response(clean.ranges_m - distance)
    rows = np.repeat(point[None], clean.samples.shape[0], axis=0).astype(np.complex64)
    turned = whitened(replace(clean, samples=rows))
    expected = filtered.response(clean.ranges_m - distance)
    inner = np.abs(clean.ranges_m - distance) < 0.12
    assert np.abs(turned.samples[0] - expected)[inner].max() < 0.03
    assert abs(filtered.response.samples[len(filtered.response.samples) // 2]) == pytest.approx(1.0)


def lead(scans: BasebandScans) -> float:
    """Of container-90 over whatever has no tag, among few bodies, nats."""
    some = contest(scans, list(LAYOUTS.values()))
    some.transfers, some.sheets = (BARE, POINTS, *WALLS[:2], SHADES[1]), ()
    hypotheses = some.run()
    best = decide(hypotheses).best
    assert best is not None and best.name == "container-90"
    return best.log_z - max(h.log_z for h in hypotheses if not h.tagged)


def test_a_tag_on_a_can_shows_more_clearly_in_noise_whose_shape_is_known() -> None:
    """Least squares that weigh all frequencies alike see less: the noise of the middle of the band rules."""
    scans = scans_of(NoiseShape(0.8), 10.0, 0, "can:30mm,height=100mm")
    assert lead(scans) > lead(replace(scans, noise_shape=())) + 20
