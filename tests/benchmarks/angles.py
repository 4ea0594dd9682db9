"""How true the angles are, per motion source, over real wires in real time; and what they do to the reader.

Every angle is held against the emulator's own truth at the moment of the scan.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from firmware_tools.virtual.process import BoardProcess
from tagid.angles.align import measured_angles
from tagid.angles.clock import fit_clock
from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M
from tagid.errors import TagidError
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.metadata import Track
from tagid.motion.device import Motion
from tagid.motion.emulation.body import Body, BodySettings
from tagid.motion.emulation.gatt import GattPort
from tagid.motion.emulation.pty import PtyPort
from tagid.motion.emulation.roomba import RoombaHost
from tagid.motion.emulation.table import ComximCore, RevopointCore, TurningTable
from tagid.motion.roomba.device import step_period_s
from tagid.motion.roomba.odometry import NOMINAL_SCALE_SIGMA, SpinOdometry
from tagid.motion.tables.revopoint import CHARACTERISTIC, SERVICE
from tagid.motion.urls import open_motion
from tagid.pipeline.resolve import one_turn, with_angles
from tagid.pipeline.turn import resolve_turn
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.memory import MemoryLink
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.reading.reader import read
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.recorder import Watch, record
from tagid.simulate import Acquisition, TurningScene, scene_from_name
from tagid.tags.layouts.layout import builtin_layouts
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, share

AXIS_M = 1.0
LAYOUTS = list(builtin_layouts().values())
CONFIG = {"name": "bench", "passkey": None, "uart_tx": 4, "uart_rx": 5, "brc_pin": 6, "index_pin": 7}
FLOORS = ((225.0, 0.00), (235.0, 0.02), (243.0, 0.01), (258.0, 0.02), (270.0, 0.00))
"""True wheel base, mm, and slip: effective bases 4 % under to 15 % over the nominal one."""


def scan_with(
    motion: Motion, url: str, truth: Callable[[float], float], turns: float, seed: int, folder: Path
) -> tuple[Capture, np.ndarray]:
    """A recording of so many turns and the true angle of each of its scans, rad."""
    log: list[float] = []

    def logged(moment: float) -> float:
        log.append(truth(moment))
        return log[-1]

    acquisition = Acquisition(axis_distance_m=AXIS_M, snr_db=20)
    scene = TurningScene(scene_from_name("helmet-120", seed), 0, seed, acquisition, true_angle=logged)
    config = plan_window(AXIS_M, 0.5, 0.0, RadarConfig(base_integration_index=13))
    radar = P440(MemoryLink(EmulatorCore(scene, config), rate=1.0), 2.0)
    path = folder / f"{threading.get_ident()}-{seed}-{time.monotonic_ns()}.tagid.h5"
    limit = 600.0 if motion.measures else turns * (motion.nominal_s or 30.0)
    plan = RecordingPlan(
        config, AXIS_M, motion=url, max_seconds=limit, scans=None if motion.measures else 65_000
    )
    capture = record(radar, motion, plan, path, Watch(resolve=with_angles))
    path.unlink()
    assert capture.views <= len(log) and capture.scan_id is not None
    first = capture.scan_id - capture.scan_id[0]
    return capture, np.array(log)[first]


def errors_deg(angles: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """(rms, worst) error, degrees, up to the one constant that no image notices."""
    error = np.degrees(angles - truth)
    error -= error.mean()
    return float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())


class Rows:
    """The table as it grows, from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self.folder = folder
        self.found: dict[str, list[tuple[float, float]]] = {}

    def add(self, name: str, error: tuple[float, float]) -> None:
        with self._lock:
            self.found.setdefault(name, []).append(error)

    def table(self) -> Table:
        """A row for each source of angles."""
        rows = []
        for name in sorted(self.found):
            rms, worst = np.array(self.found[name]).T
            rows.append((name, len(rms), f"{np.sqrt(np.mean(rms**2)):.2f}", f"{worst.max():.2f}"))
        return Table(("motion", "runs", "rms, degrees", "worst, degrees"), rows)


def roomba(rows: Rows, wire: str, number: int, turns: float) -> None:
    """One robot: as it is, with the wheel base of another recording of it, and checked by the radar."""
    base, slip = FLOORS[number % len(FLOORS)]
    body = BodySettings(base, slip, slip_noise=0.002, encoder_noise=0.5, imbalance=0.01, seed=number)
    with ExitStack() as stack:
        host = stack.enter_context(RoombaHost(body))
        url = f"roomba+serial://{host.port.path}"
        if wire == "bridge":
            board = stack.enter_context(BoardProcess(CONFIG, host.port.path, "--interval-ms", "15"))
            url = f"roomba+ble://{board.address}?hci={board.hci}&wait=20"
        url += ("&" if "?" in url else "?") + f"step=3&turns={turns * (base / 235) if turns > 1.2 else turns}"

        def truth(moment: float) -> float:
            with host.port.lock:
                return host.core.body.heading_at(moment)

        kept: list[tuple[np.ndarray, np.ndarray, float]] = []
        for run in range(2):
            capture, true = scan_with(open_motion(url), url, truth, turns, 10 * number + run, rows.folder)
            assert capture.angles_rad is not None
            scale = float(capture.motion.resolved.scale)
            kept.append((capture.angles_rad, true, scale))
        angles, true, scale = kept[1]
        rows.add(f"Roomba by {wire}, encoders alone", errors_deg(angles / scale, true))
        rows.add(f"Roomba by {wire}, calibrated before", errors_deg(angles / scale * kept[0][2], true))
        rows.add(f"Roomba by {wire}, this scan's own period", errors_deg(angles, true))


def table(rows: Rows, kind: str, number: int, turns: float) -> None:
    """One table that tells its angle, or its index pulses, or nothing."""
    with ExitStack() as stack:
        if kind == "Comxim":
            core = ComximCore(0.03, time.monotonic())
            port = stack.enter_context(PtyPort(core))
            url, plate = f"comxim+serial://{port.path}?turns={turns}", core.table
        elif kind == "Revopoint":
            other = RevopointCore(0.02, time.monotonic())
            air = stack.enter_context(GattPort(other, "REVO_DUAL_AXIS_TABLE", SERVICE, CHARACTERISTIC))
            url, plate = f"revopoint+ble://?hci={air.hci}&period=20&turns={turns}", other.table
        else:
            plate = TurningTable(time.monotonic())
            plate.turn(360 / (20 * 1.03))
            url = "free?rpm=3"
            if kind == "index pulse":
                board = stack.enter_context(BoardProcess(CONFIG, "loop"))
                url = f"index+ble://{board.address}?hci={board.hci}&wait=20&rpm=3&turns={turns}"
                threading.Thread(target=pulses, args=(board, plate), daemon=True).start()
        capture, true = scan_with(
            open_motion(url),
            url,
            lambda moment: float(plate.state(moment)["angle_rad"]),
            turns,
            number,
            rows.folder,
        )
        assert capture.angles_rad is not None
        resolved = capture.motion.resolved
        inside = slice(None)
        if kind == "index pulse":
            track_turns = resolved.turns * 2 * np.pi
            moving = np.abs(capture.angles_rad - capture.angles_rad[0])
            inside = slice(int(np.argmax(moving > 0.01)), int(np.argmax(moving >= track_turns - 0.01)))
        if kind != "free":
            rows.add(
                f"{kind}, as told", errors_deg(capture.angles_rad[inside] / resolved.scale, true[inside])
            )
        name = f"{kind}, this scan's own period" if kind != "free" else "free, period from the scans"
        rows.add(name, errors_deg(capture.angles_rad[inside], true[inside]))


def pulses(board: BoardProcess, plate: TurningTable) -> None:
    """The magnet passes the sensor once a turn."""
    period = 360 / plate.speed_deg_s
    begin = plate.now_s
    for turn in range(1, 1000):
        time.sleep(max(0.0, begin + turn * period - time.monotonic()))
        try:
            board.command("index")
        except (OSError, ValueError, TagidError):
            return


def first_angles(run: Run) -> Iterator[Table]:
    """Seconds from the command to the first angle."""
    starts, rows = run.number(10, 2), []
    run.seeds = "none"
    for wire in ("cable", "bridge"):
        with ExitStack() as stack:
            host = stack.enter_context(RoombaHost())
            url = f"roomba+serial://{host.port.path}"
            if wire == "bridge":
                board = stack.enter_context(BoardProcess(CONFIG, host.port.path))
                url = f"roomba+ble://{board.address}?hci={board.hci}"
            seconds = []
            for _ in range(starts):
                motion = open_motion(url)
                motion.start()
                motion.stop()
                seconds.append(motion.first_angle_s)  # type: ignore[attr-defined]
        rows.append((f"by {wire}", starts, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"))
    columns = ("robot", "starts", "seconds from the command to the first angle, median", "longest")
    yield Table(columns, rows)


def identification(run: Run) -> Iterator[Table]:
    """Rate at which the four layouts are named at 10 dB, turned by a robot and by an even table."""
    seeds, rows = run.number(15), []
    run.seeds = f"{seeds} per layout"
    for how in ("turntable, period from the scans", "Roomba, not calibrated"):
        right = wrong = total = 0
        for layout in LAYOUTS:
            for seed in range(seeds):
                answer = read_once(layout.name, how.startswith("Roomba"), seed, 10.0)
                total += 1
                right += answer == layout.name
                wrong += answer not in (layout.name, None)
        rows.append((how, total, share(right, total), wrong))
    yield Table(
        ("turned by", "scenes", "named rightly (%)", "named wrongly"), rows, "360 scans a turn, 10 dB."
    )


def read_once(name: str, robot: bool, seed: int, snr_db: float) -> str | None:
    """One scene in simulated time; what it is named."""
    base, slip = FLOORS[seed % len(FLOORS)]
    rng = np.random.default_rng(seed)
    body = Body(BodySettings(base, slip, slip_noise=0.002, encoder_noise=0.5, seed=seed))
    nominal = step_period_s(2)
    speed = 2 * 28.5
    period = nominal * base / 235 / (1 - slip)
    step = period / 360
    readings: list[tuple[int, float, float]] = []
    truth: list[float] = []
    odometry = SpinOdometry(1)
    if robot:
        body.drive(speed, -speed)
    times = np.arange(0, 1.45 * period, step)
    frame = 0.0
    for moment in times:
        while frame <= moment:
            body.advance(frame)
            odometry.add(*body.encoders())
            # Bluetooth hands readings over late, in bundles of up to 30 ms.
            arrival = round((frame + rng.uniform(0, 0.03)) * 1e9)
            readings.append((arrival, odometry.angle_rad, odometry.sigma_rad))
            frame += 0.015
        body.advance(moment)
        truth.append(body.heading_rad if robot else 2 * np.pi * moment / period)
    # The truth at hand, then the time asked for: a scene turned by either.
    known = dict(zip(times.tolist(), truth, strict=True))
    acquisition = Acquisition(axis_distance_m=AXIS_M, snr_db=snr_db)
    scene = TurningScene(
        scene_from_name(name, seed), 0, seed, acquisition, true_angle=lambda moment: known[moment]
    )
    scene.follow(lambda moment: moment)
    config = plan_window(AXIS_M, 0.5, 0.0, RadarConfig())
    samples = np.stack([scene.scan(i, float(moment), config) for i, moment in enumerate(times)])
    stamps = np.floor(times * 1e3)
    arrivals = np.asarray((times + rng.uniform(0, 0.005, len(times))) * 1e9, dtype=np.int64)
    capture = Capture(
        samples.astype(np.int32),
        config.range_start_m(0.0),
        RANGE_STEP_M,
        axis_distance_m=AXIS_M,
        radar_time_ms=stamps,
        host_time_ns=arrivals,
    )
    try:
        if robot:
            info = {"scale_sigma": NOMINAL_SCALE_SIGMA, "step_s": 0.015, "kind": "roomba"}
            measured = measured_angles(samples, fit_clock(stamps), arrivals, Track.of(readings, info))
            capture = replace(capture, angles_rad=measured.angles_rad, angle_sigma_rad=measured.sigma_rad)
        else:
            capture = resolve_turn(capture, "free")
        scans = preprocess(
            one_turn(capture, 360), settings=PreprocessSettings(matched_filter=False, extent_m=0.5)
        )
        return read(scans, LAYOUTS).layout
    except TagidError:
        return None


def errors(run: Run) -> Iterator[Table]:
    """Every source over real wires, two robots or four tables at a time."""
    short = run.quick
    run.seeds = "5 per robot and 1 per table"
    turns = 1.3 if short else 3.0
    rows = Rows(run.folder)
    rounds: list[list[tuple[Callable[..., None], tuple[object, ...]]]] = [
        [(roomba, ("cable", n)), (roomba, ("bridge", n))] for n in range(1 if short else 5)
    ]
    tables = ["Comxim"] if short else ["Comxim", "Revopoint", "index pulse", "free"]
    rounds.append([(table, (kind, number)) for number, kind in enumerate(tables)])
    for together in rounds:
        threads = [
            threading.Thread(target=work, args=(rows, *arguments, turns)) for work, arguments in together
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    yield rows.table()
