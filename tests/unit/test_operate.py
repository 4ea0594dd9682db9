"""Between recording and answer: joint answers, errors that name the recording, the history, the words."""

from __future__ import annotations

import io
import re
import sqlite3
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from tagid.capture import Capture
from tagid.cli.imaging import describe
from tagid.config import data_folder
from tagid.errors import ConfigError, DataError
from tagid.metadata import RadarInfo, ScanGap
from tagid.operate.truth import Comparison, compare
from tagid.operate.turn import Answer, draw, failed, read, read_jointly
from tagid.operate.words import bound_words, coverage_words, notes, trust_words, truth_words
from tagid.operate.workplace import MOST_SCANS, NOT_COMMISSIONED, Workplace
from tagid.pipeline.answer import Identification
from tagid.reading.calibration import Bound
from tagid.result import Redrawn
from tagid.simulate import Acquisition, Placement, scene_from_name, simulate_capture
from tagid.storage.hdf5 import write_capture
from tagid.storage.history import FILE_NAME
from tagid.tags.layouts.layout import builtin_layouts

BOUND = Bound(1 / 4700, 0.001, 4999, "24 to 360 views", "simulated objects")
SETTINGS = {"radar.url": "emulator://empty", "motion.axis_distance_m": 1.0, "imaging.method": "bp",
            "imaging.pixels": 32}  # fmt: skip


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workplace:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    return Workplace(SETTINGS)


def recording(seed: int, placement: Placement = Placement((0.003, -0.002), 0.3)) -> Capture:
    acquisition = Acquisition(views=16, placement=placement)
    return simulate_capture(scene_from_name("helmet-120", seed), acquisition, seed)[0]


def shown(answer: Answer, verbose: bool = False) -> list[str]:
    printed = io.StringIO()
    Console(file=printed, width=400).print(Redrawn(describe(answer, "", verbose), str))
    return [line.rstrip() for line in printed.getvalue().splitlines()]


def test_the_screen_has_the_name_how_far_to_trust_it_and_nothing_else_unasked(place: Workplace) -> None:
    answer = read(place.setup(), recording(2), "a.tagid.h5")
    name, trust, truth = shown(answer)
    assert name == "HELMET-120   Helmet, 120 degrees"
    assert re.fullmatch(r"  at most 1 in [1-9][\d,]+ such objects is named wrongly \(simulated\)", trust)
    assert truth.startswith("  truth: helmet-120: named rightly, rotation ")
    assert any(line.startswith("  read as: ") for line in shown(answer, verbose=True))
    result = answer.identification
    part = replace(result, coverage=0.42, reading=replace(result.reading, bound=None))
    assert shown(replace(answer, identification=part))[1] == (
        "  no bound on wrong names: the views cover 151 of 360 degrees"
    )
    early = replace(result, coverage=0.7)
    assert "  caution: the views cover 252 of 360 degrees" in shown(replace(answer, identification=early))


def test_an_answer_stands_beside_the_truth_of_its_capture(place: Workplace) -> None:
    whole = recording(2)
    answer = read(place.setup(), whole)
    assert answer.name == "helmet-120" and answer.truth is not None and answer.truth.right
    # Over the symmetry of three equal angles: a third of a turn more or less is the same pose.
    for turned in (0.0, 118.0, 240.0, -359.0):
        truth = replace(whole.object.truth, rotation_deg=whole.object.truth.rotation_deg + turned)
        other = replace(whole, object=replace(whole.object, truth=truth))
        seen = compare(other, answer.identification, builtin_layouts().values())
        assert abs(seen.rotation_error_deg + (turned + 60) % 120 - 60) < 1
    assert answer.truth.centre_error_m < 2e-3
    emulated = replace(whole, radar=replace(whole.radar, kind=None))
    beside = compare(emulated, answer.identification, builtin_layouts().values())
    assert beside == Comparison("helmet-120", True), "its table turned before the first scan"
    layout = builtin_layouts()["helmet-120"]
    measured = replace(layout, covariance=np.tile(1e-8 * np.eye(2), (3, 1, 1)))
    assert compare(whole, answer.identification, [measured]) == Comparison("helmet-120", True)
    for carried, right in ((None, False), ("container-90", False), ("helmet-120", True)):
        other = replace(whole, object=replace(whole.object, layout=carried))
        assert compare(other, answer.identification, []).right == right
    unsure = replace(answer.identification, status="ambiguous")
    assert compare(whole, unsure, []) == Comparison("helmet-120", False)
    assert compare(whole, Identification("failed", None, None, None), []) is None
    wrong = replace(answer.truth, right=False, rotation_error_deg=None, centre_error_m=None)
    assert truth_words(wrong) == "helmet-120: not named"
    bare = replace(whole, object=replace(whole.object, layout=None))
    assert compare(bare, Identification("no_tag", None, None, None), []) == Comparison(None, True)


def test_a_recording_that_is_given_again_says_nothing_more(place: Workplace) -> None:
    once = recording(3)
    copy = replace(once, uuid="another")
    twice = read_jointly(place.setup(), [once, copy])
    assert len(twice.alone) == 1 and "1 recording given again" in twice.remarks[-1]
    alone = read_jointly(place.setup(), [once])
    assert twice.identification.reading.lead == alone.identification.reading.lead


def test_a_joint_answer_has_the_remarks_and_causes_of_its_recordings(place: Workplace) -> None:
    noted = recording(2)
    lossy = replace(noted.radar, scans_lost=2)
    noted = replace(noted, object=replace(noted.object, note="gate 4"), radar=lossy)
    joint = read_jointly(place.setup(), [recording(3), noted])
    document = joint.to_dict()
    assert joint.name == "helmet-120" and not joint.causes and document["recording_note"] == "gate 4"
    assert [remark for remark in joint.remarks if "scans lost" in remark]
    assert [vote["layout"] for vote in document["votes"]] == ["helmet-120"] * 2
    assert document["votes"][0]["score"] > 0.5 and document["votes"][0]["margin"] > 0
    assert joint.truth == Comparison("helmet-120", True), "of several poses"
    other = replace(noted, object=replace(noted.object, layout="container-90"))
    assert read_jointly(place.setup(), [recording(3), other]).truth is None, "of two objects"
    parts = [whole.select(np.flatnonzero(whole.angles_rad < np.pi)) for whole in (noted, recording(3))]
    part = read_jointly(place.setup(), parts)
    assert part.name is None and [cause.code for cause in part.causes] == ["partial_turn"]
    with pytest.raises(DataError, match="no common image"):
        draw(joint, None)


def test_a_picture_is_drawn_where_the_reflectors_were_read(place: Workplace, tmp_path: Path) -> None:
    """With an axis distance wrong by 12 cm there is nothing to be seen where the rings are."""
    whole = recording(3, Placement())
    wrong = Workplace({**SETTINGS, "motion.axis_distance_m": 1.12})
    answer = read(wrong.setup(), whole)
    assert answer.name == "helmet-120" and "1.00 m, not 1.12 m" in answer.remarks[0]
    drawn = draw(answer, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000 and not drawn.body_subtracted
    image = drawn.result.image
    brightest = image.grid.points[np.argmax(np.abs(image.values))] + image.centre_m
    reflectors = [(r.x_m, r.y_m) for r in answer.identification.reading.reflectors if r.matched]
    assert np.linalg.norm(np.array(reflectors) - brightest, axis=1).min() < 0.015
    right = draw(read(place.setup(), whole), None).result
    assert right.image.settings["axis_distance_m"] == pytest.approx(1.0, abs=0.02)
    assert image.settings["axis_distance_m"] == pytest.approx(1.0, abs=0.02)


def test_an_error_names_the_recording_once_and_not_its_copy(place: Workplace, tmp_path: Path) -> None:
    copy = tmp_path / "copy.tagid.h5"
    copy.write_bytes(b"nothing")
    answer = read(place.setup(), copy, "a.tagid.h5")
    message = answer.to_dict()["error"]["message"]
    assert answer.status == "failed" and message.count("a.tagid.h5") == 1 and str(copy) not in message
    assert failed(DataError("no samples", ""), "b").to_dict()["error"]["message"] == "b: no samples"
    with pytest.raises(type(answer.error)):
        read_jointly(place.setup(), [copy])


def test_the_time_of_a_recording_is_that_of_its_file_however_soon_it_is_read(
    place: Workplace, tmp_path: Path
) -> None:
    capture = recording(2)
    write_capture(tmp_path / "a.tagid.h5", capture)
    fields = ("samples", "range_start_m", "range_step_m", "angles_rad", "axis_distance_m")
    np.savez(tmp_path / "timeless.npz", **{name: getattr(capture, name) for name in fields})
    stored, timeless = (read(place.setup(), tmp_path / name) for name in ("a.tagid.h5", "timeless.npz"))
    assert stored.recorded_utc == read(place.setup(), capture).recorded_utc is not None
    assert timeless.name == "helmet-120" and timeless.recorded_utc is None


def test_answers_of_one_workplace_are_one_run_of_the_history(place: Workplace) -> None:
    with place:
        for _ in range(2):
            assert not place.identify(recording(2)).notes
    with place:
        place.identify_together([recording(2)])
    for _ in range(2):
        place.identify(recording(2))
    rows = sqlite3.connect(data_folder() / FILE_NAME).execute("SELECT run_id FROM identification ORDER BY id")
    assert rows.fetchall() == [(1,), (1,), (2,), (3,), (4,)]


def test_limits_and_settings_of_a_recording_are_checked(place: Workplace) -> None:
    assert place.plan(1, 1e-3).scans == 1 and place.plan(MOST_SCANS, 86400).scans == MOST_SCANS
    for scans, seconds in ((0, 1), (MOST_SCANS + 1, 1), (1, 0), (1, 86401)):
        with pytest.raises(ConfigError):
            place.plan(scans, seconds)
    with pytest.raises(ConfigError, match="rotation axis is unknown"):
        Workplace({"radar.url": "udp://127.0.0.1"}).plan()
    assert Workplace({"radar.url": "replay:///a.tagid.h5"}).plan().config is None
    backgrounds = {name: Workplace(background=name).imaging().background for name in ("median", "reference")}
    assert backgrounds == {"median": "median", "reference": "none"}
    assert place.imaging().focus_m is None and place.imaging(focus=False).focus_m == 0


def test_the_words_on_trust_never_promise_more_than_the_bound(place: Workplace) -> None:
    answer = read(place.setup(), recording(2)).identification
    at = lambda bound: trust_words(replace(answer, reading=replace(answer.reading, bound=bound)))  # noqa: E731
    assert at(BOUND) == "at most 1 in 4,700 such objects is named wrongly (simulated)"
    assert "1 in 4,600 " in at(replace(BOUND, p_value=1 / 4699)), "rounded to the safe side"
    assert at(replace(BOUND, p_value=0.0021)).endswith("; set is 1 in 1,000")
    assert at(None) == "no bound on wrong names: answers of this kind are not calibrated"
    assert coverage_words(0.5) == "the views cover 180 of 360 degrees" and not coverage_words(0.98)
    assert not coverage_words(None)
    assert "too few objects" in bound_words(replace(BOUND, objects=99))
    over = bound_words(replace(BOUND, p_value=0.0021))
    assert over.startswith("false accept at most 0.0021 (0.001 is set)")
    assert truth_words(Comparison(None, True)) == "no tag: nothing named"
    assert truth_words(Comparison(None, False, instead="mine")) == "no tag: named wrongly"
    assert truth_words(Comparison("mine", False, instead="helmet-120")) == "mine: named wrongly"


def test_a_radar_that_is_lost_often_has_perhaps_another_user() -> None:
    gap = ScanGap(1, 2.0, "timeout", False)
    (once,) = notes(RadarInfo(gap_count=1, gaps=(gap,)))
    (twice,) = notes(RadarInfo(gap_count=2, gaps=(gap, gap)))
    assert "lost once, for 2.0 s" in once and "another program" not in once
    assert "lost 2 times, for 4.0 s" in twice and twice.endswith("is another program using it?")


def test_an_answer_without_a_name_says_that_its_own_radar_is_not_commissioned(place: Workplace) -> None:
    real = Workplace({**SETTINGS, "radar.url": "udp://127.0.0.1"})
    said = {
        status: [at.without_profile(cast(Answer, SimpleNamespace(status=status))) for at in (real, place)]
        for status in ("no_tag", "unknown", "identified", "failed")
    }
    told = [(NOT_COMMISSIONED,), ()]
    assert said == {"no_tag": told, "unknown": told, "identified": [(), ()], "failed": [(), ()]}
