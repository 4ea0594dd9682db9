"""The live view: sums that grow by one view are those of the whole, and a recording never waits for them."""

from __future__ import annotations

import gc
import io
import threading
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from tagid.capture import Capture
from tagid.errors import CaptureInterrupted, DataError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.live.angles import GrowingSpeed, LiveAngles
from tagid.live.ats import PIECE_VIEWS, GrowingAts
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.image import GrowingImage
from tagid.live.state import LiveState, Phase
from tagid.live.sure import EarlyEnding
from tagid.live.views import GrowingViews, capture_so_far, evidence_of
from tagid.motion.urls import open_motion
from tagid.pipeline import identify as identify_module
from tagid.pipeline.answer import Identification
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.pipeline.turn import resolve_turn
from tagid.radar.assembler import Scan
from tagid.radar.settings import RadarConfig
from tagid.reading.decision import SURE
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.recording.session import Session
from tagid.recording.stream import ScanStream
from tagid.report.live_screen import draw
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.tags.layouts.layout import builtin_layouts
from tagid.workers import check_wanted
from tests.unit.paced import wait_for

GRID = ImageGrid(0.4, 48)
LAYOUTS = list(builtin_layouts().values())
RAW = PreprocessSettings(background="none", extent_m=0.4)


def a_capture(views: int = 40, snr_db: float = 15.0) -> Capture:
    return simulate_capture(scene_from_name("helmet-120", 3), Acquisition(views=views, snr_db=snr_db), 3)[0]


def batch_image(capture: Capture) -> np.ndarray:
    return backproject(preprocess(capture, settings=replace(RAW, background="mean")), GRID).values


@pytest.mark.parametrize("parts", [(1,) * 40, (3, 17, 20)], ids=["singly", "in parts"])
def test_the_growing_image_is_the_batch_image_to_rounding(parts: tuple[int, ...]) -> None:
    """Also over static clutter a thousand times the echo, which the mean removes only at the end."""
    clean = a_capture()
    clutter = 1e3 * np.abs(clean.samples).max() * np.sin(0.7 * np.arange(clean.bins))
    cluttered = replace(clean, samples=(clean.samples + clutter).astype(np.float32))
    for capture, most in ((cluttered, 2e-3), (clean, 2e-6)):
        growing = GrowingImage(GRID)
        at = 0
        for count in parts:
            growing.add(preprocess(capture.select(slice(at, at + count)), settings=RAW))
            at += count
        whole = batch_image(capture)
        assert growing.views == 40
        assert np.abs(growing.image().values - whole).max() < most * np.abs(whole).max()


def test_an_image_in_the_middle_of_the_turn_is_that_of_the_views_so_far() -> None:
    capture = a_capture()
    growing = GrowingImage(GRID)
    assert not growing.image().values.any()
    part = capture.select(slice(0, 13))
    growing.add(preprocess(part, settings=RAW))
    whole = batch_image(part)
    assert np.abs(growing.image().values - whole).max() < 2e-6 * np.abs(whole).max()
    moved = replace(capture, range_start_m=capture.range_start_m + 0.05)
    with pytest.raises(DataError, match="do not continue"):
        growing.add(preprocess(moved.select(slice(13, 14)), settings=RAW))


def test_a_third_of_a_turn_shows_which_layout_is_ahead() -> None:
    capture = a_capture(90, snr_db=10.0)
    part = capture.select(slice(0, 30))
    evidence = evidence_of(part, LAYOUTS, ImagingSettings())
    assert len(evidence) == len(LAYOUTS) and evidence[0].layout == "helmet-120"
    assert evidence[0].lead > 20 and all(item.lead < 0 for item in evidence[1:])
    assert evidence[1].lead == pytest.approx(evidence[1].log_evidence - evidence[0].log_evidence)
    assert evidence_of(capture.select(slice(0, 5)), LAYOUTS, ImagingSettings()) == (), "too few views"
    noise = np.random.default_rng(5).normal(0, 100, part.samples.shape).astype(np.float32)
    of_noise = evidence_of(replace(part, samples=noise), LAYOUTS, ImagingSettings())
    assert len(of_noise) == len(LAYOUTS) and all(item.log_evidence < SURE for item in of_noise)


def test_a_fit_that_goes_on_with_each_piece_is_as_good_as_one_from_scratch() -> None:
    """By the residual on the same held-out views."""
    capture = a_capture(96, snr_db=20.0)
    ats = AtsSettings(engine="native")
    imaging = ImagingSettings(method="ats", extent_m=0.4, pixels=48, restore=False, ats=ats)
    growing = GrowingAts(GRID, imaging)
    views = [count for count in range(1, 97) if growing.due(count)]
    assert views[0] == PIECE_VIEWS
    for count in range(PIECE_VIEWS, 97, PIECE_VIEWS):
        assert growing.due(count)
        growing.go_on(capture.select(slice(0, count)))
    image = growing.go_on(capture, last=True)
    scans = preprocess(capture, settings=imaging.preprocessing(matched_filter=False))
    scratch = fit(scans, GRID, ats)
    assert growing.views == 96 and not growing.due(97)
    assert growing.held_out < 1.02 * scratch.held_out
    alike = np.abs(np.vdot(scratch.image.values, image.values))
    assert alike > 0.9 * np.linalg.norm(scratch.image.values) * np.linalg.norm(image.values)
    few = replace(ats, steps=8)
    assert fit(scans, GRID, few, start=scratch.field).held_out < 0.7 * fit(scans, GRID, few).held_out
    with pytest.raises(UsageError, match="another grid"):
        fit(scans, ImageGrid(0.4, 40), ats, start=scratch.field)


def scan_of(number: int, time_ms: int, samples: np.ndarray | None = None) -> Scan:
    values = np.zeros(8, dtype=np.int32) if samples is None else samples
    return Scan(number, time_ms, time_ms * 1_000_000, values, 0, 1, 2)


def test_the_scans_so_far_keep_both_antennas() -> None:
    """The live image and the answers read ahead would otherwise take one antenna for two."""
    config = RadarConfig(base_integration_index=13)
    plan = RecordingPlan(config, 1.1, antenna_height_m=0.2, antenna_separation_m=0.3, cable_delay_ps=500.0)
    session = cast(Session, SimpleNamespace(plan=plan, config=config))
    capture = capture_so_far(session, [scan_of(i, 100 * i, np.full(8, i, dtype=np.int32)) for i in range(3)])
    assert capture.samples[:, 0].tolist() == [0, 1, 2]
    assert capture.range_start_m == config.range_start_m(500.0)
    turned = replace(capture, angles_rad=np.arange(3.0))
    assert turned.aperture().separation == pytest.approx(0.3)
    assert (turned.axis_distance_m, turned.antenna_height_m) == (1.1, 0.2)


def test_the_angle_comes_from_the_speed_and_its_sign_from_the_direction() -> None:
    scans = [scan_of(i, 100 * i) for i in range(20)]
    ccw = LiveAngles(open_motion("free?rpm=6")).of(scans)
    cw = LiveAngles(open_motion("free?rpm=6&direction=cw")).of(scans)
    np.testing.assert_allclose(ccw, 2 * np.pi * 0.01 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(cw, -ccw)
    unknown = LiveAngles(open_motion("free"))
    assert unknown.of(scans) is None
    unknown.learn(20.0)
    result = unknown.of(scans)
    np.testing.assert_allclose(result, ccw / 2, atol=1e-6)


def test_a_symmetric_tag_without_a_stated_speed_is_shown_once_imaging_tells_the_turn() -> None:
    """After 0.8 turns the scans have repeated twice; imaging finds that three repetitions are a turn."""
    acquisition = Acquisition(views=200, turns=0.8, snr_db=10)
    capture, _ = simulate_capture(scene_from_name("helmet-120", 5), acquisition, 5)
    seen = replace(capture, angles_rad=None, angle_sigma_rad=None)
    view = LiveView(LiveSettings(open_motion("free")))
    result = view.resolving(resolve_turn)(seen, "free").motion.resolved
    assert result is not None and result.repetitions_a_turn == 3
    scans = [scan_of(i, round(float(t))) for i, t in enumerate(capture.radar_time_ms)]
    plan, intake = RecordingPlan(None, None), SimpleNamespace(scans_lost=0)
    stream = ScanStream(cast(Session, SimpleNamespace(plan=plan, config=RadarConfig(), intake=intake)))
    for scan in scans:
        stream.append(scan)
    stream.end()
    with view:
        view.began(stream)
        wait_for(lambda: view.state.phase is Phase.READING)
    assert view.state.turned_rad == pytest.approx(0.8 * 2 * np.pi, rel=0.02)


def recorded(folder: Path, view: LiveView, rpm: int = 60, **more: object) -> Capture:
    """A turn of an emulated helmet in memory, as fast as it goes, with a live view."""
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=15))
    url = f"free?rpm={rpm}"
    plan = RecordingPlan(config, 1.0, motion=url, max_seconds=60.0)
    watch = Watch(resolve=view.resolving(resolve_turn), began=view.began)
    radar = open_radar(f"emulator://helmet-120?rpm={rpm}&seed=2")
    return record(radar, open_motion(url), plan, folder / "x.tagid.h5", replace(watch, **more))


def test_a_recording_is_shown_to_its_last_frame(tmp_path: Path) -> None:
    states: list[LiveState] = []
    motion = open_motion("free?rpm=60")
    imaging = ImagingSettings(pixels=48)
    with LiveView(LiveSettings(motion, LAYOUTS, imaging=imaging), states.append) as view:
        capture = recorded(tmp_path, view)
        prepared = PreparedCapture(load_capture(capture), imaging)
        answer = identify(prepared, LAYOUTS)
        view.settle(prepared.given, answer)
    last = view.state
    assert [state.frame for state in states] == sorted(state.frame for state in states)
    assert last.phase is Phase.DONE and last.final
    assert last.answer.reading.layout == "helmet-120"
    assert last.views == prepared.given.views
    whole = backproject(prepared.scans(imaging.preprocessing(matched_filter=True)), ImageGrid(0.5, 48))
    assert np.abs(last.image.values - whole.values).max() < 1e-5 * np.abs(whole.values).max()
    assert [t.name for t in threading.enumerate() if t.name.startswith("live-")] == []


def test_a_view_that_is_late_ends_with_angle_and_sinogram_of_what_was_recorded(tmp_path: Path) -> None:
    """On a busy computer the last scans of a turn arrive after the last frame that shows scans."""
    settled = threading.Event()

    def late(state: LiveState) -> None:
        if threading.current_thread().name == "live-view":
            settled.wait(60)

    settings = LiveSettings(open_motion("free?rpm=60"), LAYOUTS, imaging=ImagingSettings(pixels=48))
    with LiveView(settings, late) as view:
        capture = recorded(tmp_path, view)
        prepared = PreparedCapture(load_capture(capture), ImagingSettings(pixels=48))
        view.settle(prepared.given, identify(prepared, LAYOUTS))
        settled.set()
    assert view.state.final
    best = view.state.evidence[0]
    assert best.layout == "helmet-120" and best.lead > SURE
    assert view.state.turned_rad > 2 * np.pi
    assert view.state.scans == capture.views and view.state.seconds > 1.4
    assert np.ptp(view.state.sinogram.rows) > 0 and view.state.snr_db is not None


@dataclass(frozen=True)
class Turning:
    """Scans of an emulated object, 10 s per turn, as a recording of unknown speed hands them over."""

    session: Session
    scans: list[Scan]

    @classmethod
    @cache
    def of(cls, scene: str) -> Turning:
        """1.3 turns."""
        config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=15))
        plan = RecordingPlan(config, 1.0, motion="free", max_seconds=13.0)
        streams: list[ScanStream] = []
        radar = open_radar(f"emulator://{scene}?rpm=6&seed=2&snr=10")
        with TemporaryDirectory() as folder:
            watch = Watch(began=streams.append)
            record(radar, open_motion("free?rpm=6"), plan, Path(folder) / "a.tagid.h5", watch)
        return cls(streams[0].session, streams[0].since())

    def thinned(self, every: int) -> Turning:
        """Of a slower radar, whose scans are read in less time."""
        scans = [replace(scan, scan_id=number) for number, scan in enumerate(self.scans[::every])]
        return Turning(self.session, scans)

    def part(self, turns: float) -> list[Scan]:
        """The scans of the first turns."""
        return [s for s in self.scans if s.radar_time_ms - self.scans[0].radar_time_ms <= 1e4 * turns]


@pytest.mark.parametrize(
    ("scene", "earliest", "latest"),
    [("helmet-120", 0.35, 0.45), ("helmet-linear", 0.55, 0.65), ("container-90", 1.1, 1.25), ("empty", 9, 9)],
)
def test_an_unknown_speed_is_found_as_soon_as_the_scans_repeat(
    scene: str, earliest: float, latest: float
) -> None:
    """A wrong multiple or a chance repetition would show an image of nothing, and read a wrong turn."""
    turning = Turning.of(scene)
    speed = GrowingSpeed()
    results: list[tuple[float, float]] = []
    for count in range(1, len(turning.scans) + 1, 2):
        period = speed.period_s(turning.session, turning.scans[:count])
        if period is not None:
            results.append((count / len(turning.scans) * 1.3, period))
    if scene == "empty":
        assert results == []
        return
    assert earliest < results[0][0] < latest
    assert [period for _, period in results] == pytest.approx([10.0] * len(results), rel=5e-3)
    assert len(results) < 10, "a new estimate forms all views again"


def test_image_and_answer_precede_the_end_of_a_turn_of_unknown_speed() -> None:
    turning = Turning.of("helmet-120").thinned(2)
    with LiveView(LiveSettings(open_motion("free"), LAYOUTS, imaging=ImagingSettings(pixels=48))) as view:
        stream = ScanStream(turning.session)
        view.began(stream)
        half = turning.part(0.55)
        for number, scan in enumerate(half):
            stream.append(scan)
            if number % 10 == 0:
                wait_for(lambda seen=number: view.state.scans > seen)
        wait_for(lambda: view.state.scans == len(half) and view.state.image is not None)
        assert view.state.turned_rad == pytest.approx(0.55 * 2 * np.pi, rel=0.02)
        assert view.state.evidence[0].layout == "helmet-120"
        for scan in turning.scans[len(half) :]:
            stream.append(scan)
        wait_for(lambda: view.state.answer is not None)
        answer, final = view.state.answer, view.state.final
        stream.end()
    assert answer is not None and answer.reading is not None and not final
    assert answer.reading.layout == "helmet-120"


def test_closed_watchers_hold_no_scans_and_are_freed_without_the_garbage_collector(tmp_path: Path) -> None:
    """The recording refers to its view by the callback for gaps, and the view to the recording."""
    kinds = (Scan, ScanStream, Session, EarlyEnding, LiveView)

    def alive() -> list[int]:
        return [sum(type(get_object) is kind for get_object in gc.get_objects()) for kind in kinds]

    def watched() -> None:
        settings = LiveSettings(open_motion("free?rpm=60"), LAYOUTS)
        with LiveView(settings) as view, EarlyEnding(settings) as ending:
            began = ending.watching(Watch(began=view.began)).began
            recorded(tmp_path, view, began=began, gap=lambda gap: view.note("a gap"))
            wait_for(lambda: (view.state.views or 0) > 5)
        after = alive()
        assert after[:3] == before[:3] and not view._views.count, "scans and sums go with the watchers"
        assert after[3:] == [count + 1 for count in before[3:]]

    gc.collect()
    before = alive()
    gc.disable()
    try:
        watched()
        assert alive() == before
    finally:
        gc.enable()


def test_a_view_that_fails_or_hangs_costs_no_scan(tmp_path: Path) -> None:
    motion = open_motion("free?rpm=60")
    held = threading.Event()

    def hang(state: LiveState) -> None:
        if threading.current_thread().name == "live-view":
            held.wait(60)

    with LiveView(LiveSettings(motion), hang) as view:
        capture = recorded(tmp_path, view)
        held.set()
    assert capture.complete and capture.radar.scans_lost == 0 == capture.radar.scans_dropped

    def fail(state: LiveState) -> None:
        if threading.current_thread().name == "live-view":
            raise RuntimeError("a fault in the view")

    (tmp_path / "x.tagid.h5").unlink()
    with LiveView(LiveSettings(motion), fail) as view:
        assert recorded(tmp_path, view).complete
    assert "the live view stopped (unexpected RuntimeError); the recording continues" in view.state.note


@pytest.mark.parametrize("thread", ["live-view", "live-reader", "live-fitter"])
@pytest.mark.parametrize("starts", [True, False])
def test_a_worker_of_the_view_that_dies_is_a_remark_and_costs_no_scan(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    thread: str,
    starts: bool,
) -> None:
    """Whatever the exception, nothing is written to the terminal, and the recording goes on."""

    def dies(*_: object, **__: object) -> None:
        raise MemoryError

    real = threading.Thread.start

    def start(self: threading.Thread) -> None:
        if self.name == thread:
            raise RuntimeError("can't start new thread")
        real(self)

    inside = {
        "live-view": (LiveView, "_take"),
        "live-reader": (identify_module, "identify"),
        "live-fitter": (GrowingAts, "go_on"),
    }
    if starts:
        monkeypatch.setattr(*inside[thread], dies)
    else:
        monkeypatch.setattr(threading.Thread, "start", start)
    imaging = ImagingSettings(method="ats" if thread == "live-fitter" else "bp")
    known = LiveSettings(open_motion("free?rpm=30"), LAYOUTS, imaging=imaging)
    words = "MemoryError" if starts else f"no {thread}"
    remarked = threading.Event()

    def tell(state: LiveState) -> None:
        if words in state.note and "the recording continues" in state.note:
            remarked.set()

    with LiveView(known, tell) as view:

        def resolve(capture: Capture, motion: str) -> Capture:
            assert remarked.wait(60)
            return resolve_turn(capture, motion)

        assert recorded(tmp_path, view, rpm=30, resolve=resolve).complete
    assert "Traceback" not in capfd.readouterr().err


def test_a_reading_ahead_stops_with_the_recording() -> None:
    """It would delay the reading of the stored capture."""
    turning = Turning.of("helmet-120")
    view = LiveView(LiveSettings(open_motion("free?rpm=6"), LAYOUTS, imaging=ImagingSettings(pixels=48)))
    stream, asked = ScanStream(turning.session), threading.Event()
    view._stream = stream

    def identified(*_: object) -> Identification:
        asked.set()
        while True:
            check_wanted()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identify_module, "identify", identified)
        for scan in turning.scans:
            stream.append(scan)
        angles = np.linspace(0, 2.1 * np.pi, len(turning.scans))
        view._read_ahead(stream, turning.scans, angles)
        assert asked.wait(60) and view._reader is not None and view._reader.alive
        stream.end()
        assert view._reader.join(60) and view._reader.failure is None
    assert view.state.answer is None and view.state.note == ""
    view.close()


def test_the_final_answer_stays_and_a_new_one_has_its_own_time() -> None:
    first, other = (Identification(status, None, None, None) for status in ("no_tag", "unknown"))
    view = LiveView(LiveSettings(open_motion("free?rpm=60")))
    view._answered_ahead(first)
    ahead_at = view._answer_at
    view._answered(first)
    assert view._answer_at == ahead_at, "the same answer was there before"
    view._answered(other)
    assert view._answer_at is not None and view._answer_at > ahead_at
    view._answered_ahead(first)
    assert view.state.final and view.state.answer is other


def test_stop_ends_a_recording_and_keeps_its_scans(tmp_path: Path) -> None:
    streams: list[ScanStream] = []
    with (
        LiveView(LiveSettings(open_motion("free?rpm=60"))) as view,
        pytest.raises(CaptureInterrupted, match="stopped after") as stopped,
    ):

        def began(stream: ScanStream) -> None:
            streams.append(stream)
            view.began(stream)

        recorded(tmp_path, view, began=began, stop=lambda: len(streams[0]) >= 10)
    assert str(tmp_path / "x.tagid.h5") in stopped.value.remedy
    assert len(streams[0]) >= 10 and streams[0].ended


@pytest.fixture(scope="module")
def hostile() -> LiveState:
    """A state whose last layout has a control character in its name."""
    capture = a_capture(20)
    evidence = evidence_of(capture, LAYOUTS, ImagingSettings())
    views = GrowingViews(GRID, (), ImagingSettings(extent_m=0.4))
    views.update(replace(capture, angles_rad=None), capture.angles_rad - capture.angles_rad[0])
    names = (*evidence[:-1], replace(evidence[-1], layout="a\x1b[31m"))
    return LiveState(Phase.TURNING, scans=20, turned_rad=3.0, image=views.image(), evidence=names)


@pytest.mark.parametrize(
    ("size", "colour"), [((80, 24), True), ((200, 60), False), ((20, 5), True), ((65535, 65535), False)]
)
def test_the_screen_fits_any_terminal_and_hides_no_control_character(
    size: tuple[int, int], colour: bool, hostile: LiveState
) -> None:
    out = io.StringIO()
    console = Console(
        file=out, width=min(size[0], 640), height=size[1], force_terminal=colour, no_color=not colour
    )
    console.print(draw(hostile, "tagid scan \x1b[2J", size, colour))
    text = out.getvalue()
    assert "\x1b[2J" not in text and "a\x1b[31m" not in text
    if size[0] >= 80:
        assert "172 of 360 deg" in text and "helmet-120" in text
        assert len(text.splitlines()) <= min(size[1], 200)
