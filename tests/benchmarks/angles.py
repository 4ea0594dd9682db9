"""How true the angles are, per motion source, over real wires in real time; and what they do to the reader.

Every angle is held against the emulator's own truth at the moment of the scan.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
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
from tests.benchmarks.tables import Table, rms, share

AXIS_M = 1.0
LAYOUTS = list(builtin_layouts().values())
CONFIG = {"name": "bench", "passkey": None, "uart_tx": 4, "uart_rx": 5, "brc_pin": 6, "index_pin": 7}
FLOORS = ((225.0, 0.00), (235.0, 0.02), (243.0, 0.01), (258.0, 0.02), (270.0, 0.00))
"""True wheel base, mm, and slip: effective bases 4 % under to 15 % over the nominal one."""


def scan_with(
    url: str, truth: Callable[[float], float], turns: float, seed: int, folder: Path
) -> tuple[Capture, np.ndarray]:
    """A recording of so many turns and the true angle of each of its scans, rad."""
    motion, log = open_motion(url), list[float]()

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
    assert capture.views <= len(log)
    first = capture.scan_id - capture.scan_id[0]
    return capture, np.array(log)[first]


def errors_deg(angles: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """(rms, worst) error, degrees, up to the one constant that no image notices."""
    error = np.degrees(angles - truth)
    error -= error.mean()
    return rms(error), float(np.abs(error).max())


Errors = list[tuple[str, tuple[float, float]]]
"""Source of angles, and (rms, worst) error, degrees."""


def roomba(folder: Path, wire: str, number: int, turns: float) -> Errors:
    """One robot: as it is, with the wheel base of another recording of it, and checked by the radar."""
    base, slip = FLOORS[number % len(FLOORS)]
    body = BodySettings(base, slip, slip_noise=0.002, encoder_noise=0.5, imbalance=0.01, seed=number)
    with ExitStack() as stack:
        host = stack.enter_context(RoombaHost(body))
        url = f"roomba+serial://{host.port.path}?"
        if wire == "bridge":
            board = stack.enter_context(BoardProcess(CONFIG, host.port.path, "--interval-ms", "15"))
            url = f"roomba+ble://{board.address}?hci={board.hci}&wait=20&"
        url += f"step=3&turns={turns * (base / 235) if turns > 1.2 else turns}"

        def truth(moment: float) -> float:
            with host.port.lock:
                return host.core.body.heading_at(moment)

        first, (capture, true) = (scan_with(url, truth, turns, 10 * number + run, folder) for run in range(2))
    bare = capture.angles_rad / float(capture.motion.resolved.scale)
    before = float(first[0].motion.resolved.scale)
    return [
        (f"Roomba by {wire}, encoders alone", errors_deg(bare, true)),
        (f"Roomba by {wire}, calibrated before", errors_deg(bare * before, true)),
        (f"Roomba by {wire}, this scan's own period", errors_deg(capture.angles_rad, true)),
    ]


def table(folder: Path, kind: str, number: int, turns: float) -> Errors:
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
            url, lambda moment: float(plate.state(moment)["angle_rad"]), turns, number, folder
        )
    resolved, inside = capture.motion.resolved, slice(None)
    if kind == "index pulse":
        moving = np.abs(capture.angles_rad - capture.angles_rad[0])
        last = np.argmax(moving >= resolved.turns * 2 * np.pi - 0.01)
        inside = slice(int(np.argmax(moving > 0.01)), int(last))
    angles, true = capture.angles_rad[inside], true[inside]
    if kind == "free":
        return [("free, period from the scans", errors_deg(angles, true))]
    return [
        (f"{kind}, as told", errors_deg(angles / resolved.scale, true)),
        (f"{kind}, this scan's own period", errors_deg(angles, true)),
    ]


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
    starts, rows = run.number(10, 2), []
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
                seconds.append(motion.first_angle_s)
        rows.append((f"by {wire}", starts, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"))
    yield Table("robot | starts | seconds from the command to the first angle, median | longest", rows)


def identification(run: Run) -> Iterator[Table]:
    """Rate at which the four layouts are named at 10 dB, turned by a robot and by an even table."""
    seeds, rows = run.number(15), []
    run.seeds = f"{seeds} per layout"
    for how in ("turntable, period from the scans", "Roomba, not calibrated"):
        names = [
            (layout.name, read_once(layout.name, how.startswith("Roomba"), seed))
            for layout in LAYOUTS
            for seed in range(seeds)
        ]
        right = sum(answer == name for name, answer in names)
        wrong = sum(answer not in (name, None) for name, answer in names)
        rows.append((how, len(names), share(right, len(names)), wrong))
    yield Table("turned by | scenes | named rightly (%) | named wrongly", rows, "360 scans a turn, 10 dB.")


def read_once(name: str, robot: bool, seed: int) -> str | None:
    """One scene in simulated time, at 10 dB; what it is named."""
    base, slip = FLOORS[seed % len(FLOORS)]
    rng = np.random.default_rng(seed)
    body = Body(BodySettings(base, slip, slip_noise=0.002, encoder_noise=0.5, seed=seed))
    period = step_period_s(2) * base / 235 / (1 - slip)
    readings: list[tuple[int, float, float]] = []
    # The truth at hand, then the time asked for: a scene turned by either.
    known: dict[float, float] = {}
    odometry = SpinOdometry(1)
    if robot:
        body.drive(57.0, -57.0)
    times = np.arange(0, 1.45 * period, period / 360)
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
        known[float(moment)] = body.heading_rad if robot else 2 * np.pi * moment / period
    acquisition = Acquisition(axis_distance_m=AXIS_M, snr_db=10.0)
    scene = TurningScene(scene_from_name(name, seed), 0, seed, acquisition, true_angle=known.__getitem__)
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
    """A row for each source of angles over real wires, two robots or four tables at a time."""
    run.seeds = "5 per robot and 1 per table"
    turns, robots = (1.3, 1) if run.quick else (3.0, 5)
    tables = ("Comxim",) if run.quick else ("Comxim", "Revopoint", "index pulse", "free")
    rounds = [
        [partial(roomba, run.folder, wire, n, turns) for wire in ("cable", "bridge")] for n in range(robots)
    ]
    rounds.append([partial(table, run.folder, kind, number, turns) for number, kind in enumerate(tables)])
    made: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def attempt(work: Callable[[], Errors]) -> Errors:
        try:
            return work()
        except TagidError as error:  # on a busy machine the dead-man timer ends runs
            run.say(f"left out: {error}")
            return []

    with ThreadPoolExecutor(4) as pool:
        for together in rounds:
            for some in pool.map(attempt, together):
                for name, error in some:
                    made[name].append(error)
    rows = []
    for name in sorted(made):
        each, worst = np.array(made[name]).T
        rows.append((name, len(each), f"{rms(each):.2f}", f"{worst.max():.2f}"))
    yield Table("motion | runs | rms, degrees | worst, degrees", rows)
