"""One answer from several recordings: what is weak alone, what is noise, and what is no enrolled tag."""

from __future__ import annotations

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.errors import DataError
from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.vote import read_together

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
