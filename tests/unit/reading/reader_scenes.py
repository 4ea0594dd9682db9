"""Recordings of simulated tags for the tests of the reader."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.capture import Capture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.reading.spectra import Spectra
from tagid.simulate.acquisition import Acquisition, Placement
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_layout
from tagid.simulate.scattering import Points, Returns
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = tuple(builtin_layouts().values())


class Shaded(Points):
    """Reflectors that are seen within 65 degrees of their outward side alone."""

    def returns(self, antennas: np.ndarray) -> Returns:
        seen = super().returns(antennas)
        apart = antennas[:, None, :2] - self.positions[None, :, :2]
        away = np.angle(np.exp(1j * (np.arctan2(apart[..., 1], apart[..., 0]) - self.facing_rad)))
        return Returns(seen.points, np.where(np.abs(away) > np.deg2rad(65), 0.0, seen.amplitudes))


def scans_at(
    places_m: np.ndarray,
    *,
    views: int = 36,
    snr_db: float = 10.0,
    turns: float = 1.0,
    offset_m: float = 0.003,
    seed: int = 3,
    shaded: bool = False,
) -> BasebandScans:
    """A recording of reflectors at places (K, 2), m, whose middle stands off the axis."""
    space = np.concatenate([places_m, np.zeros((len(places_m), 1))], axis=1)
    scene = scene_from_layout(space, "tag", seed)
    if shaded:
        parts = (Shaded(**vars(p)) if isinstance(p, Points) else p for p in scene.object)
        scene = replace(scene, object=tuple(parts))
    placement = Placement((offset_m, offset_m / 2))
    acquisition = Acquisition(views=views, snr_db=snr_db, turns=turns, placement=placement)
    return prepared(simulate_capture(scene, acquisition, seed)[0])


def prepared(capture: Capture) -> BasebandScans:
    """A recording as the reader takes it."""
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))


def scans_of(name: str, **how: float) -> BasebandScans:
    """A recording of a built-in layout."""
    return scans_at(builtin_layouts()[name].positions, **how)  # type: ignore[arg-type]


def spectra_of(name: str, **how: float) -> Spectra:
    """Its spectra."""
    return Spectra.of(scans_of(name, **how))
