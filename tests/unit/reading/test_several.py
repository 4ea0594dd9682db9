"""Several recordings of one object: what they share decides, and more of them say more."""

from __future__ import annotations

from functools import cache

import numpy as np
from reader_scenes import LAYOUTS, scans_at

from tagid.reading.decision import Decision, decide
from tagid.reading.hypotheses import Contest
from tagid.reading.several import decide_together
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.tags.layouts.layout import builtin_layouts


@cache
def contest(positions: tuple[tuple[float, float], ...], seed: int, snr_db: float) -> Contest:
    scans = scans_at(np.array(positions), views=18, snr_db=snr_db, seed=seed, offset_m=0.002 + 0.001 * seed)
    result = Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS), ())
    result.run()
    return result


def placed(name: str) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in builtin_layouts()[name].positions)


def together(positions: tuple[tuple[float, float], ...], snr_db: float) -> tuple[list[Decision], Decision]:
    contests = [contest(positions, seed, snr_db) for seed in (1, 2, 3)]
    return [decide(contest.hypotheses) for contest in contests], decide_together(contests)


def test_recordings_that_name_nothing_alone_name_the_tag_together() -> None:
    alone, joint = together(placed("container-90"), -1.5)
    assert [design.name for design in alone] == [None] * 3
    assert (joint.status, joint.name) == ("identified", "container-90")


def test_more_recordings_lead_farther() -> None:
    alone, joint = together(placed("helmet-120"), 5.0)
    assert joint.name == "helmet-120"
    assert joint.lead > max(design.lead for design in alone)


def test_a_stranger_loses_farther_with_more_recordings() -> None:
    positions = tuple((0.045 * np.cos(a), 0.045 * np.sin(a)) for a in np.deg2rad([0, 130]))
    alone, joint = together(positions, 5.0)
    assert joint.status == "unknown" and joint.reason.startswith("2 reflectors")
    assert joint.lead < min(design.lead for design in alone)


def test_recordings_of_two_tags_are_not_named() -> None:
    contests = [contest(placed(name), 2, 15.0) for name in ("container-90", "container-180")]
    assert [decide(contest.hypotheses).name for contest in contests] == ["container-90", "container-180"]
    assert decide_together(contests).name is None


def test_one_recording_is_decided_as_alone() -> None:
    single = contest(placed("container-90"), 2, 15.0)
    assert decide_together([single]).lead == decide(single.hypotheses).lead
