"""The prior follows the data: other priors are tried where unseen views ask for them, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import BETTER, CANDIDATES, fit_adapted
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tests.unit.imaging_scenes import record, turn

GRID = ImageGrid(0.3, 40)
QUICK = AtsSettings(steps=40)


def outline(views: int = 60) -> BasebandScans:
    """Scans of an ellipse of 64 scatterers of random phase, each seen only where it faces the antenna."""
    rng = np.random.default_rng(4)
    t = np.arange(64) * 2 * np.pi / 64
    points = np.column_stack([0.11 * np.cos(t), 0.07 * np.sin(t)])
    normals = np.column_stack([np.cos(t) / 0.11, np.sin(t) / 0.07])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    phases = np.exp(2j * np.pi * rng.random(64))
    aperture = turn(views)
    rows = []
    for view in range(views):
        sight = aperture.positions[view, :2] - points
        facing = (sight * normals).sum(axis=1) / np.linalg.norm(sight, axis=1)
        one = aperture.select(np.array([view]))
        rows.append(record(points, phases * np.maximum(facing, 0), one, start_m=0.4, analytic=True).samples)
    whole = record(points, phases, aperture, start_m=0.4, analytic=True)
    seen = replace(whole, samples=np.vstack(rows))
    return preprocess(seen, settings=PreprocessSettings("none", False, extent_m=GRID.extent))


def test_an_outline_seen_from_its_side_gets_another_prior_that_predicts_better() -> None:
    result = fit_adapted(outline(), GRID, AtsSettings())
    tried = result.image.settings["prior_trials"]
    chosen = result.image.settings["prior"]
    assert set(tried) == {"default", *CANDIDATES}
    assert chosen == min(tried, key=lambda name: tried[name])
    assert tried[chosen] < BETTER * tried["default"]
    for name, value in CANDIDATES[chosen].items():
        assert result.image.settings[name] == value


def test_points_keep_the_default_prior_without_a_trial() -> None:
    scans = preprocess(
        record([[0.05, 0.02], [-0.06, 0.01]], [1, 1], turn(36), noise=0.02),
        settings=PreprocessSettings("none", False, extent_m=GRID.extent),
    )
    assert "prior" not in fit_adapted(scans, GRID, QUICK).image.settings


def test_a_prior_given_by_hand_is_not_changed() -> None:
    scans = outline(24)
    for settings in (AtsSettings(steps=5, adapt=0), AtsSettings(steps=5, l1=0.1)):
        assert "prior" not in fit_adapted(scans, GRID, settings).image.settings
