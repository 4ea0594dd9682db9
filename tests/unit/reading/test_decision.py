"""Names, refusals and their reasons on simulated recordings."""

from __future__ import annotations

import numpy as np
import pytest
from reader_scenes import LAYOUTS, scans_at, scans_of

from tagid.reading.decision import SURE, Decision
from tagid.reading.reader import read


def ring(*angles_deg: float, radius_m: float = 0.045) -> np.ndarray:
    """(K, 2) places on a ring, m."""
    angle = np.deg2rad(angles_deg)
    return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.name)
def test_a_tag_is_named(layout: object) -> None:
    answer = read(scans_of(layout.name), LAYOUTS)  # type: ignore[attr-defined]
    assert (answer.status, answer.name) == ("identified", layout.name)  # type: ignore[attr-defined]
    assert answer.lead > SURE


@pytest.mark.parametrize("turns", [0.75])
def test_a_tag_is_named_on_part_of_a_turn(turns: float) -> None:
    assert read(scans_of("container-90", turns=turns), LAYOUTS).name == "container-90"


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
    answer = read(scans_at(places), LAYOUTS)
    assert answer.status == "unknown" and answer.name is None
    assert answer.lead < SURE
    assert words in answer.reason


def test_more_signal_keeps_the_name() -> None:
    def lead(snr_db: float) -> Decision:
        return read(scans_of("container-180", snr_db=snr_db), LAYOUTS)

    assert [lead(snr_db).name for snr_db in (5.0, 15.0, 30.0)] == ["container-180"] * 3
