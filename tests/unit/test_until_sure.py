"""A scan that ends before the turn does: when it may, what it stores, and what is said of it."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import ConfigError, DeviceError, DeviceTimeoutError, ModelError
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.sure import EarlyEnding, check_angle_known
from tagid.metadata import Ending, Track
from tagid.motion.device import MotionStoppedError
from tagid.motion.turntable import FreeTurntable
from tagid.motion.urls import open_motion
from tagid.pipeline.diagnosis import recording_remarks
from tagid.pipeline.identify import ended_answer, identify, widest_gap
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.pipeline.turn import resolve_turn
from tagid.radar.settings import RadarConfig
from tagid.reading import looks
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS, SPENT, VIEWS_PER_TURN, Look, agreed, largest, look, part_of_turn
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import read_capture
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.paced import paced

CALIBRATION = EndingCalibration("made up", (0, 3999), LOOKS, 32, 3999, ())
URL = "free?rpm=30"


def recorded(
    path: Path,
    ending: EarlyEnding,
    scene: str = "helmet-120",
    motion: FreeTurntable | None = None,
    watch: Watch | None = None,
    scans: int | None = None,
) -> Capture:
    """A turn in memory, as fast as it goes; each scan waits for the looks, whatever the computer's speed."""
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=15))
    plan = RecordingPlan(config, 1.0, motion=URL, scans=scans)
    radar = open_radar(f"emulator://{scene}?rpm=30&seed=2")
    watch = watch or paced(ending, Watch(resolve=resolve_turn))
    return record(radar, motion or open_motion(URL), plan, path, watch)


def settings(motion: FreeTurntable | None = None, **imaging: float) -> LiveSettings:
    layouts = list(builtin_layouts().values())
    given = ImagingSettings(**{"false_accept": 1e-3, **imaging})
    return LiveSettings(motion or open_motion(URL), layouts, imaging=given)


def test_a_scan_ends_at_the_first_look_that_is_sure_and_the_capture_says_why(tmp_path: Path) -> None:
    with EarlyEnding(settings(), CALIBRATION) as ending:
        capture = recorded(tmp_path / "x.tagid.h5", ending)
    assert [look.share for look in ending.looks] == [0.45, 0.6]
    expected = Ending("sure", 0.6, "helmet-120", 1 / 4000, 3999)
    stored = read_capture(tmp_path / "x.tagid.h5")
    assert capture.complete and stored.complete and not list(tmp_path.glob("*.journal"))
    assert capture.radar.ended == stored.radar.ended == expected
    prepared = PreparedCapture(load_capture(capture))
    assert 0.59 < widest_gap(prepared.given).share < 0.65
    assert recording_remarks(prepared.given) == ()
    as_interrupted = replace(prepared.given, radar=replace(prepared.given.radar, ended=None))
    assert "degrees" in recording_remarks(as_interrupted)[0]
    answer = ended_answer(identify(prepared, settings().layouts), capture.radar.ended, 1e-3, CALIBRATION)
    assert (answer.status, answer.reading and answer.reading.layout) == ("identified", "helmet-120")
    bound = answer.to_dict()["bound"]
    assert bound["p_value"] == 1 / 4000 and bound["calibration_objects"] == 3999
    assert bound["false_accept"] == SPENT * 1e-3 and bound["population"] == "made up"


def test_what_leaves_no_bound_is_said() -> None:
    known = settings()
    pairs = [layout for layout in known.layouts if layout.size == 2]
    few = "holds 1000 revolutions, too few for tags.false_accept = 0.001"
    assert EarlyEnding(known, replace(CALIBRATION, turns=1000)).remark.endswith(few)
    either = EarlyEnding(settings(direction_known=False), CALIBRATION)
    assert either.remark.endswith("the direction of rotation is unknown")
    small = EarlyEnding(replace(known, layouts=pairs), CALIBRATION)
    assert small.remark.endswith("no enrolled layout has 3 reflectors or more")


def test_without_a_name_the_whole_turn_is_recorded(tmp_path: Path) -> None:
    with EarlyEnding(settings(), CALIBRATION) as ending:
        capture = recorded(tmp_path / "x.tagid.h5", ending, "can")
    assert not ending.remark and capture.radar.ended == Ending("turn")
    assert capture.motion.resolved.turns > 1.2


@pytest.mark.parametrize("starts", [True, False])
def test_an_ending_whose_thread_dies_records_the_whole_turn_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], starts: bool
) -> None:
    real = threading.Thread.start

    def dies(*_: object) -> None:
        raise MemoryError

    def start(thread: threading.Thread) -> None:
        if thread.name == "live-ending":
            raise RuntimeError("can't start new thread")
        real(thread)

    if starts:
        monkeypatch.setattr(EarlyEnding, "_look", dies)
    else:
        monkeypatch.setattr(threading.Thread, "start", start)
    with EarlyEnding(settings(), CALIBRATION) as ending:
        capture = recorded(tmp_path / "x.tagid.h5", ending)
    assert capture.radar.ended == Ending("turn") and capture.complete
    assert "`until_sure` recorded the whole revolution: reading ahead stopped" in ending.remark
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("error", [MotionStoppedError("it fell"), DeviceTimeoutError("no scan arrived")])
def test_a_scan_that_fails_leaves_no_thread_and_no_ending(tmp_path: Path, error: DeviceError) -> None:
    motion = FreeTurntable(20.0)
    checks = []

    def check() -> None:
        checks.append(1)
        if len(checks) > 25:
            raise error

    motion.check = check  # type: ignore[method-assign]
    known = settings(motion)
    with (
        pytest.raises(type(error), match=error.message) as failed,
        LiveView(known) as view,
        EarlyEnding(known, CALIBRATION) as ending,
    ):
        watch = ending.watching(Watch(began=view.began))
        recorded(tmp_path / "x.tagid.h5", ending, motion=motion, watch=watch)
    assert ending.enough() is None
    kept = read_capture(tmp_path / "x.tagid.h5")
    assert kept.views == 26 and not kept.complete and kept.radar.ended is None
    assert str(tmp_path / "x.tagid.h5") in failed.value.remedy
    assert [item.name for item in threading.enumerate() if item.name.startswith(("live-", "motion-"))] == []


class _Uncalibrated(FreeTurntable):
    """A table whose readings state a scale that may be 6 % off."""

    def track(self) -> Track:  # type: ignore[override]
        return Track.of([(0, 0.0, 0.0)], {"scale_sigma": 0.06})


def test_an_angle_of_uncertain_scale_ends_no_scan(tmp_path: Path) -> None:
    motion = _Uncalibrated(30.0)
    with EarlyEnding(settings(motion), CALIBRATION) as ending:
        watch = ending.watching(Watch())
        capture = recorded(tmp_path / "x.tagid.h5", ending, motion=motion, watch=watch, scans=150)
    assert capture.radar.ended == Ending("limit") and ending.looks == []
    assert "not calibrated" in ending.remark


def test_a_pair_of_reflectors_ends_no_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, _ = simulate_capture(scene_from_name("container-90", 2), Acquisition(views=24, snr_db=20), 2)
    part, pairs = part_of_turn(capture, 0.75), [layout for layout in settings().layouts if layout.size == 2]
    assert look(part, pairs, 0.75).layout is None
    monkeypatch.setattr(looks, "LEAST_REFLECTORS", 2)
    assert look(part, pairs, 0.75).layout == "container-90"


def test_a_name_that_the_last_scans_contradict_is_withdrawn() -> None:
    capture, _ = simulate_capture(scene_from_name("helmet-120", 3), Acquisition(views=24, snr_db=20), 3)
    answer = identify(capture, settings().layouts)
    assert answer.status == "identified"
    other = ended_answer(answer, Ending("sure", 0.45, "container-90", 1e-4, 9999), 1e-3, CALIBRATION)
    assert other.status == "unknown"
    assert other.reading.layout is None and other.reading.code.value == "recordings_disagree"
    assert "container-90" in other.reading.reason and other.to_dict()["bound"] is None
    assert ended_answer(answer, Ending("turn"), 1e-3, CALIBRATION) is answer
    assert ended_answer(answer, None, 1e-3, CALIBRATION) is answer


def looks_of(*named: tuple[str | None, float]) -> list[Look]:
    return [Look(LOOKS[i], 40, layout, score) for i, (layout, score) in enumerate(named)]


def test_two_looks_in_a_row_have_to_name_the_same() -> None:
    assert agreed(looks_of(("a", 5.0))) == (None, -inf)
    assert agreed(looks_of(("a", 5.0), ("a", 3.0))) == ("a", 3.0)
    assert agreed(looks_of(("a", 2.0), ("b", 3.0))) == (None, -inf)
    assert agreed(looks_of((None, -inf), (None, -inf))) == (None, -inf)
    assert largest(looks_of(("a", 5.0), ("a", 3.0), ("a", 4.0))) == 3.0
    assert largest(looks_of(("a", 5.0), ("b", 9.0), ("b", 8.0))) == 8.0
    assert largest(looks_of(("a", 5.0), (None, -inf), ("a", 8.0))) == -inf


def test_the_bound_holds_over_the_largest_score_of_all_looks() -> None:
    """Scores of any distribution, correlated over the looks: false endings stay within the stated rate."""
    # Of 3,999 turns one ended on a name: no more can have reached any score.
    single = replace(CALIBRATION, scores=(30.0,))
    for score in (40.0, 20.0):
        both = looks_of(("a", score), ("a", score))
        assert single.bound(both, 0.01).p_value == (1 + (score < 30.0)) / 4000
    rng = np.random.default_rng(4)
    false_accept, ended, trials = 0.1 / SPENT, 0, 2000
    for _ in range(trials):
        shared = rng.standard_cauchy((200, 1))
        scores = shared + rng.standard_normal((200, 3))
        known = np.minimum(scores[1:, :-1], scores[1:, 1:]).max(axis=1)
        calibration = replace(CALIBRATION, turns=199, scores=tuple(np.sort(known)[::-1]))
        new = looks_of(*(("a", float(s)) for s in scores[0]))
        ended += any(calibration.bound(new[:count], false_accept).kept for count in (2, 3))
    rate, stated = ended / trials, SPENT * false_accept
    assert 0.07 < rate < stated + 3 * np.sqrt(stated * (1 - stated) / trials)


def test_the_calibration_is_read_back_and_a_damaged_one_is_refused() -> None:
    made = replace(CALIBRATION, scores=(3.5, 1.25))
    assert EndingCalibration.from_json(made.to_json()) == made
    good = json.loads(made.to_json())
    for damage in ({"looks": [0.5]}, {"format_version": 99}, {"scores": None}, {"seeds": [1]}):
        with pytest.raises(ModelError, match="damaged"):
            EndingCalibration.from_json(json.dumps({**good, **damage}))


def test_the_shipped_calibration_promises_no_more_than_it_counted() -> None:
    shipped = EndingCalibration.shipped()
    assert shipped.seeds[1] - shipped.seeds[0] == shipped.turns >= len(shipped.scores)
    counted = replace(shipped, turns=max(shipped.turns, 1))
    looks = looks_of(("helmet-120", 1e6), ("helmet-120", 1e6))
    enough = 1 / (SPENT * (counted.turns + 1))
    assert counted.bound(looks, 1.01 * enough).kept and counted.reaches(1.01 * enough)
    assert not counted.reaches(0.99 * enough)


def test_a_part_of_a_turn_is_cut_by_angle_and_averaged_to_a_bounded_number_of_views() -> None:
    capture, _ = simulate_capture(scene_from_name("helmet-120", 1), Acquisition(views=360), 1)
    for turned in (capture, replace(capture, angles_rad=1.0 - capture.angles_rad)):
        part = part_of_turn(turned, 0.3)
        assert part.angles_rad is not None and abs(part.views - 0.3 * VIEWS_PER_TURN) <= 2
        away = (part.angles_rad - turned.angles_rad[0] + np.pi) % (2 * np.pi) - np.pi
        assert float(np.ptp(away)) == pytest.approx(0.6 * np.pi, abs=0.1)
    sparse = capture.select(slice(None, None, 10))
    assert part_of_turn(sparse, 0.5).views == 19


def test_an_angle_that_is_found_in_the_scans_is_refused() -> None:
    with pytest.raises(ConfigError, match="`until_sure` needs the angle") as refused:
        check_angle_known(open_motion("free"), "free")
    assert "rpm=2" in refused.value.remedy
    check_angle_known(open_motion(URL), URL)
