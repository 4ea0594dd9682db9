"""Recordings of simulated tags for the tests of the reader."""

from __future__ import annotations

import numpy as np

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.reading.spectra import Spectra
from tagid.simulate.acquisition import Acquisition, Placement
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_layout
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = tuple(builtin_layouts().values())


def scans_at(
    places_m: np.ndarray,
    *,
    views: int = 36,
    snr_db: float = 10.0,
    turns: float = 1.0,
    offset_m: float = 0.003,
    height_m: float = 0.0,
    seed: int = 3,
) -> BasebandScans:
    """A recording of reflectors at places (K, 2), m, whose middle stands off the axis."""
    space = np.concatenate([places_m, np.zeros((len(places_m), 1))], axis=1)
    scene = scene_from_layout(space, "tag", seed)
    acquisition = Acquisition(
        views=views,
        snr_db=snr_db,
        turns=turns,
        antenna_height_m=height_m,
        placement=Placement((offset_m, offset_m / 2)),
    )
    capture, _ = simulate_capture(scene, acquisition, seed)
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))


def scans_of(name: str, **how: float) -> BasebandScans:
    """A recording of a built-in layout."""
    return scans_at(builtin_layouts()[name].positions, **how)  # type: ignore[arg-type]


def spectra_of(name: str, **how: float) -> Spectra:
    """Its spectra."""
    return Spectra.of(scans_of(name, **how))
