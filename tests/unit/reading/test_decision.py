"""Names, refusals and their reasons on simulated recordings."""

from __future__ import annotations

import numpy as np
import pytest
from reader_scenes import LAYOUTS, scans_at, scans_of

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.reading.decision import SURE, Decision, decide
from tagid.reading.hypotheses import Contest
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.wall import WALLS
from tagid.tags.layouts.layout import Layout
from train.population import draw


def ring(*angles_deg: float, radius_m: float = 0.045) -> np.ndarray:
    """(K, 2) places on a ring, m."""
    angle = np.deg2rad(angles_deg)
    return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bare(scans: BasebandScans) -> Decision:
    """The decision among hypotheses without sheets and walls, which none of these objects has."""
    return decide(Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS), ()).run())


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.name)
def test_a_tag_is_named(layout: Layout) -> None:
    answer = bare(scans_of(layout.name))
    assert (answer.status, answer.name) == ("identified", layout.name)
    assert answer.lead > SURE


def test_a_tag_is_named_on_part_of_a_turn() -> None:
    assert bare(scans_of("container-90", turns=0.75)).name == "container-90"


STRANGERS = {
    "another angle": (ring(0, 130), "2 reflectors"),
    "another radius": (ring(0, 180, radius_m=0.07), "2 reflectors 1"),
    "one more": (np.concatenate([ring(0, 90), [[-0.09, -0.02]]]), "3 reflectors"),
    "one less": (ring(0, 120, radius_m=0.11), "2 reflectors 120 degrees apart, 1"),
    "one": (ring(0), "one reflector"),
}


@pytest.mark.parametrize("kind", STRANGERS)
def test_a_stranger_is_described_and_not_named(kind: str) -> None:
    places, words = STRANGERS[kind]
    answer = bare(scans_at(places))
    assert answer.status == "unknown" and answer.name is None
    assert answer.lead < SURE
    assert words in answer.reason


def test_more_signal_keeps_the_name() -> None:
    names = [bare(scans_of("container-180", snr_db=snr_db)).name for snr_db in (5.0, 15.0, 30.0)]
    assert names == ["container-180"] * 3


def test_a_foreign_pair_on_an_oval_shell_is_not_named() -> None:
    capture = draw(6_000_150).capture
    scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    answer = decide(Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS, WALLS[0]), ()).run())
    assert answer.name is None
    assert "an object without a tag" in answer.reason
