"""One answer from several recordings: what is weak alone, what is noise, and what is no enrolled tag."""

from __future__ import annotations

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.errors import DataError, UsageError
from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.vote import read_together
from tagid.tags.reading.decision import (
    DecisionSettings,
    Evidence,
    chance,
    decide,
    least_preference,
    preference,
)

LAYOUTS = builtin_layouts()
ALL = list(LAYOUTS.values())


def weak(positions: np.ndarray, count: int, noise: float) -> list[BasebandScans]:
    rng = np.random.default_rng(7)
    layout = Layout("any", positions)
    return [
        synthetic_scans(
            layout.placed(rng.uniform(0, 6), rng.uniform(-0.006, 0.006, 2)), noise=noise, seed=seed
        )
        for seed in range(count)
    ]


def test_weak_recordings_together_give_the_name_that_none_gives_alone() -> None:
    joint, alone = read_together(weak(LAYOUTS["helmet-120"].positions, 5, 2.6), ALL)
    assert sum(reading.status == "identified" for reading in alone) < 5
    assert (joint.status, joint.layout) == ("identified", "helmet-120")
    assert joint.evidence.scans == 5
    assert joint.evidence.nats > max(reading.evidence.nats for reading in alone)


def test_noise_stays_noise_however_often_it_is_recorded() -> None:
    recordings = weak(LAYOUTS["helmet-120"].positions, 5, 60.0)
    assert read_together(recordings, ALL)[0].status == "no_tag"


def test_another_tag_stays_unknown_however_often_it_is_recorded() -> None:
    other = np.array([[0.1, 0.0], [0.0, 0.08], [-0.06, -0.07], [0.05, -0.1]])
    joint, _ = read_together(weak(other, 4, 0.8), ALL)
    assert joint.status in ("unknown", "no_tag") and joint.layout is None


def test_one_recording_reads_as_alone() -> None:
    joint, alone = read_together(weak(LAYOUTS["container-90"].positions, 1, 0.3), ALL)
    assert joint.layout == alone[0].layout == "container-90" and joint.evidence == alone[0].evidence
    with pytest.raises(DataError, match="recordings"):
        read_together([], ALL)


def test_chance_is_the_tail_of_the_energy_of_noise() -> None:
    rng = np.random.default_rng(1)
    energy = rng.exponential(size=(200_000, 3)).sum(axis=1)
    assert chance(6.0, 3, 1.0) == pytest.approx(float(np.mean(energy > 6.0)), rel=0.03)
    assert chance(3.0, 3, 1e6) == 1.0
    assert chance(30.0, 3, 2000.0, 1) > chance(30.0, 3, 2000.0) * 0.999
    assert chance(60.0, 3, 2000.0, 2) < chance(30.0, 3, 2000.0)


def evidence(**changed: float) -> Evidence:
    """A clear tag of three reflectors, 30 nats each."""
    usual = {
        "size": 3,
        "nats": 90.0,
        "places": 36600.0,
        "share": 1.0,
        "weakest": 0.9,
        "missing": 0,
        "extra": 0,
        "gain_nats": 7.0,
        "further_nats": 7.0,
        "odds_nats": 16.0,
        "outward": 0.0,
        "noise_nats": 90.0,
        "displacement_m": 1e-3,
        "displacement_sigma_m": 1e-3,
        "margin_share": 0.5,
        "margin_nats": 40.0,
        "views": 36,
    }
    return Evidence(**(usual | changed))  # type: ignore[arg-type]


def test_a_smaller_false_accept_asks_for_a_clearer_preference() -> None:
    tag = evidence()
    assert least_preference(tag, 1e-4) > least_preference(tag, 1e-3) > least_preference(tag, 1e-2)
    with pytest.raises(UsageError, match="false-accept"):
        DecisionSettings(false_accept=0.0)


def test_strangers_are_told_by_a_further_reflector_and_by_points_that_fit_elsewhere() -> None:
    tag = evidence()
    settings = DecisionSettings()
    assert decide(tag, settings).status == "identified"
    # A further reflector as strong as the tag's own would explain about 30 nats; 18 are half way there.
    assert preference(tag) > preference(evidence(gain_nats=12.0)) > preference(evidence(gain_nats=18.0))
    assert preference(evidence(gain_nats=1.0)) >= preference(evidence(gain_nats=5.0)) - 3
    assert decide(evidence(gain_nats=16.0, odds_nats=6.0), settings).status == "unknown"
    # Among faint reflectors, and in few views, a further one may be lost: what is enough else is not there.
    assert preference(evidence(nats=36.0, noise_nats=36.0)) < preference(tag) - 3
    assert least_preference(evidence(views=18), 1e-3) > least_preference(tag, 1e-3) + 3
    assert least_preference(evidence(views=360), 1e-3) == least_preference(tag, 1e-3)
    # However surely no further reflector is there, points elsewhere may fit better than the layout's.
    assert (
        decide(evidence(odds_nats=-16.0, noise_nats=600.0, nats=600.0, gain_nats=25.0), settings).status
        == "unknown"
    )
    # More enrolled layouts are more to be taken for.
    assert least_preference(evidence(places=366000.0), 1e-3) > least_preference(tag, 1e-3) + 2
