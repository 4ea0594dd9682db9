"""Sectors of the turn in which something hides reflectors: how they are found, and reading without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import response, synthetic_scans

from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import ReaderSettings, read_tag
from tagid.tags.matching.vote import read_together
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hidden import HiddenSectors, hidden_sectors
from tagid.tags.reading.hypotheses import search

LAYOUTS = list(builtin_layouts().values())
CENTRE = np.array([0.006, -0.004])
HALF = np.deg2rad(60.0)
"""Half of the sector that is hidden."""


def places(name: str) -> np.ndarray:
    return builtin_layouts()[name].placed(1.0, CENTRE)[:, :2]


def hidden_scans(
    points: np.ndarray, toward: np.ndarray, *, half: float = HALF, noise: float = 0.25, seed: int = 0
) -> BasebandScans:
    """Reflectors (K, 2), each hidden from antennas within `half` rad of a direction (K,)."""
    empty = synthetic_scans(points[:0], noise=noise, seed=seed)
    samples = empty.samples.astype(complex)
    antenna = empty.aperture.positions[:, :2]
    side = np.arctan2(antenna[:, 1], antenna[:, 0])
    for place, hidden in zip(points, toward, strict=True):
        d = np.hypot(*(antenna - place).T)[:, None]
        seen = np.abs(np.angle(np.exp(1j * (side - hidden)))) > half
        wave = response()(empty.ranges_m[None] - d) * np.exp(-2j * empty.wavenumber * d)
        samples += seen[:, None] * wave
    return replace(empty, samples=samples.astype(np.complex64))


def sectors_of(scans: BasebandScans, name: str) -> HiddenSectors | None:
    field = MatchedField(scans, 0.18)
    fit = next(f for f in search(field, LAYOUTS, ReaderSettings().search) if f.layout.name == name)
    return hidden_sectors(field, fit)


def test_the_views_in_which_a_reflector_is_hidden_are_found() -> None:
    toward = np.array([0.5, 3.0])
    found = sectors_of(hidden_scans(places("container-180"), toward, half=np.deg2rad(45)), "container-180")
    assert found is not None and found.nats > 100
    assert found.widths_deg == pytest.approx([90.0, 90.0], abs=30)
    antenna = synthetic_scans(places("container-180")).aperture.positions
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(antenna[:, 1], antenna[:, 0])[:, None] - toward)))).min(1)
    # To within the step of the sectors that are tried.
    assert not found.seen[off < np.deg2rad(25)].any()
    assert found.seen[off > np.deg2rad(65)].all()


@pytest.mark.parametrize("name", sorted(builtin_layouts()))
def test_a_tag_that_is_seen_from_all_sides_has_none(name: str) -> None:
    assert sectors_of(synthetic_scans(places(name), noise=0.5, seed=3), name) is None


def test_a_tag_is_named_from_the_views_that_show_it() -> None:
    """Where other explanations of all views leave less than the layout."""
    noted = 0
    for seed, toward in enumerate((0.3, 1.6, 2.9, 4.2)):
        reading = read_tag(hidden_scans(places("container-90"), np.full(2, toward), seed=seed), LAYOUTS)
        assert (reading.status, reading.layout) == ("identified", "container-90"), (toward, reading.reason)
        if reading.hidden_deg:
            noted += 1
            assert 75 <= reading.hidden_deg <= 180 and "hides a reflector" in reading.note
            assert reading.bound is not None
            won = reading.explained_by
            assert won is not None and won.layout == "container-90" and won.left < 0.2
    assert noted >= 1


def test_a_vote_of_such_recordings_names_it_too() -> None:
    points = places("container-90")
    recordings = [hidden_scans(points, np.full(2, t), seed=s) for s, t in enumerate((0.3, 1.6, 2.9))]
    joint, alone = read_together(recordings, LAYOUTS)
    assert any(one.hidden_deg for one in alone)
    assert (joint.status, joint.layout) == ("identified", "container-90")


def test_a_reflector_too_many_is_not_hidden_away() -> None:
    """Views are left out where the layout's own reflectors are hidden, never to lose another one."""
    points = places("container-90")
    for seed, angle in enumerate((0.3, 4.1)):
        more = CENTRE + 0.06 * np.array([np.cos(angle), np.sin(angle)])
        three = np.concatenate([points, more[None]])
        scans = hidden_scans(three, np.full(3, 1.0), seed=seed)
        assert read_tag(scans, LAYOUTS).status != "identified"
        only_third = hidden_scans(three, np.array([9.0, 9.0, 1.0]), half=np.deg2rad(45), seed=seed)
        assert read_tag(only_third, LAYOUTS).status != "identified"
