"""`tagid emulate`: an emulated radar, robots and turntables on real interfaces."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Terminal, announce, command, next_command
from tagid.cli.options import MILLIMETRES, PICOSECONDS, SceneOptions
from tagid.cli.outputs import check_own
from tagid.errors import DataError, DeviceError, FileFormatError, StorageError, UsageError
from tagid.result import Result
from tagid.workers import Worker

if TYPE_CHECKING:
    from tagid.metadata import ObjectInfo
    from tagid.motion.emulation.roomba import RoombaHost
    from tagid.radar.emulation.sources import ScanSource
    from tagid.radar.emulation.wires import PtyWire

DEFAULT_SCENE = "helmet-120"
WITH_REPLAY = ("seed", "rpm", "axis_distance", "snr")
"""Options that may be given beside --replay."""


@dataclass(frozen=True)
class _SceneOptions(SceneOptions):
    scene: Annotated[
        str | None,
        typer.Option(help="An enrolled layout, points-3, can, empty ...", show_default=DEFAULT_SCENE),
    ] = None
    rpm: Annotated[float, typer.Option(min=-10000, max=10000, help="Speed of the emulated table, rpm.")] = 2.0
    turned_by: Annotated[
        str | None, typer.Option(help="HOST:PORT of an emulated robot that rotates the object.")
    ] = None
    antenna_height_file: Annotated[
        Path | None, typer.Option(help="File with the antenna's height in metres, read before every scan.")
    ] = None
    budget: Annotated[
        bool, typer.Option("--budget", help="Noise from the radar equation of `tagid plan`; replaces --snr.")
    ] = False
    cable_delay: Annotated[
        float, typer.Option(parser=PICOSECONDS, min=-1e07, max=1e07, help="Delay of the emulated cables, ps.")
    ] = 0.0


@dataclass(frozen=True)
class _WireOptions:
    bind: Annotated[str, typer.Option(help="HOST:PORT to listen on; port 0: any free port.")] = (
        "127.0.0.1:21210"
    )
    serial: Annotated[bool, typer.Option("--serial", help="Use a serial port instead of UDP.")] = False
    framing: Annotated[str, typer.Option(help="Framing on the serial port: usb or uart.")] = "usb"
    baud: Annotated[int, typer.Option(min=0, max=10000000, help="Baud rate of the uart; 0: unlimited.")] = (
        115200
    )
    link: Annotated[Path | None, typer.Option(help="Symbolic link to create for the port.")] = None


@dataclass(frozen=True)
class _FaultOptions:
    lose: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Share of packets lost.", show_default="0, or that of --rig"),
    ] = None
    duplicate: Annotated[float, typer.Option(min=0, max=1, help="Share of packets sent twice.")] = 0.0
    reorder: Annotated[float, typer.Option(min=0, max=1, help="Share of packets reordered.")] = 0.0
    delay: Annotated[float, typer.Option(min=0, max=1, help="Share of packets delayed.")] = 0.0
    delay_ms: Annotated[
        float, typer.Option(min=0, max=60000, help="Delay of those packets, milliseconds.")
    ] = 20.0


@command("emulate p440")
def p440(
    terminal: Terminal,
    wire: _WireOptions,
    scene: _SceneOptions,
    faulty: _FaultOptions,
    truth: Annotated[
        Path | None, typer.Option(help="File for the true pose, to be read by scan --truth.")
    ] = None,
    replay: Annotated[str | None, typer.Option(help="Replay a recording instead.")] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat the recording endlessly.")] = False,
    rate: Annotated[float, typer.Option(min=0, max=1e06, help="Time factor; 0: as fast as possible.")] = 1.0,
    status_bytes: Annotated[
        int, typer.Option(min=0, max=1000, help="Status size: 64, or 32 as in old firmware.")
    ] = 64,
    sleep_bytes: Annotated[
        int, typer.Option(min=0, max=1000, help="Size of the sleep confirmation: 12 or 8.")
    ] = 12,
    server: Annotated[
        bool, typer.Option("--server", help="Also act as the vendor's server program.")
    ] = False,
) -> Result:
    """Emulate a P440 on UDP, or on a serial port whose path is printed, until stopped.

    Example: tagid emulate p440 --bind 127.0.0.1:21210 --scene helmet-120 --rpm 2
    """
    from tagid.files import write_bytes
    from tagid.radar.emulation.core import EmulatorCore
    from tagid.radar.emulation.emulator import ServeOptions, serve, serve_udp
    from tagid.radar.emulation.faults import Faults
    from tagid.radar.emulation.firmware import Firmware
    from tagid.simulate.rig import parse_rig

    if truth is not None:
        check_own(truth, is_truth, "a truth file")
    rig = None if scene.rig is None else parse_rig(scene.rig)
    faults = Faults(
        lose=(0.0 if rig is None else rig.loss) if faulty.lose is None else faulty.lose,
        duplicate=faulty.duplicate,
        reorder=faulty.reorder,
        delay=faulty.delay,
        delay_s=faulty.delay_ms * 1e-3,
        seed=scene.seed,
    )
    firmware = Firmware(status_bytes, sleep_bytes, server)
    host, port = ("", 0) if wire.serial else options.parse_bind(wire.bind, "127.0.0.1:21210")
    source, about, remark = _source(scene, replay, loop)
    if truth is not None:
        if about is None:
            raise UsageError("--truth with --replay: a recording has no known pose", "Omit one of them.")
        write_bytes(truth, (json.dumps(about.to_json(), indent=1) + "\n").encode())
    rpm = scene.rpm if rig is None else 60 / rig.period_s
    core = EmulatorCore(source, identity=None if rig is None else rig.identity, firmware=firmware)
    stop = threading.Event()
    run = f"tagid scan --radar {{}} --axis-distance {scene.axis_distance:g}"
    run += f" --motion 'free?rpm={rpm:.4g}'" if rpm > 0 else ""
    facts: dict[str, Any] = {} if about is None else {"object": about.to_json()}

    def ready(url: str, **more: str) -> None:
        _listens(terminal, "emulate p440", {"url": url, **more, **facts}, run, remark)

    with interrupts.asked_to_stop(stop.set):
        if wire.serial:
            pty = _pty(wire)
            end = wire.link or pty.path
            ready(f"serial://{end}{'?framing=uart' * (wire.framing == 'uart')}", port=str(end))
            serve(core, pty, ServeOptions(rate=rate, faults=faults), stop)
        else:
            udp = ServeOptions(host, port, rate, faults)
            serve_udp(core, udp, stop, lambda a, p: ready(f"udp://{a}:{p}"))
    raise typer.Exit(0)


def _source(
    scene: _SceneOptions, replay: str | None, loop: bool
) -> tuple[ScanSource, ObjectInfo | None, str | None]:
    """What the radar sees: a recording or a scene, with the emulated object and the remark on its SNR."""
    from tagid.recording.radars import emulated_recording
    from tagid.simulate.source import NOISE_INDEX
    from tagid.simulate.spec import check_unchanged, turning_scene

    if replay is not None:
        names = {item.name for item in fields(scene)}.difference(WITH_REPLAY)
        check_unchanged(scene, names, "--replay", "a recording is sent as it is")
        return emulated_recording(Path(replay), loop), None, None
    name = scene.scene or (None if scene.response else DEFAULT_SCENE)
    turning = turning_scene(scene.spec(scene=name))
    return turning, turning.about(), f"{turning.snr} at integration index {NOISE_INDEX}"


def _pty(options: _WireOptions) -> PtyWire:
    from tagid.radar.emulation.wires import PtyWire
    from tagid.radar.framing import Framing
    from tagid.radar.serial_link import BAUD_RATES

    framing, baud = options.framing, options.baud
    if framing not in ("usb", "uart"):
        raise UsageError(f"--framing is {framing!r}", "Give usb or uart.")
    if baud and baud not in BAUD_RATES:
        raise UsageError(f"--baud is {baud}", "Give 9600 to 921600, or 0 for no limit.")
    return PtyWire(Framing(framing), baud if framing == "uart" and baud else None, options.link)


_LOOK_S = 0.5
_RateError = Annotated[
    float,
    typer.Option(
        "--rate-error",
        min=-0.9,
        max=0.9,
        help="Relative difference by which it rotates slower than it reports.",
    ),
]
_Truth = Annotated[
    int,
    typer.Option(
        "--truth", help="UDP port that serves the true angle; 0 takes any free one.", min=0, max=65535
    ),
]


@command("emulate roomba")
def roomba(
    terminal: Terminal,
    pty: Annotated[bool, typer.Option("--pty", help="On a pseudo-terminal (the default).")] = False,
    ble: Annotated[bool, typer.Option("--ble", help="Behind an emulated Bluetooth bridge.")] = False,
    link: Annotated[Path | None, typer.Option(help="Symbolic link to create for the port.")] = None,
    name: Annotated[str, typer.Option(help="Name of the bridge.")] = "tagid-bridge",
    passkey: Annotated[
        str | None, typer.Option(help="Pass-key, six digits; omit for an open bridge.")
    ] = None,
    baud: Annotated[int, typer.Option(min=0, max=10000000, help="Baud rate of the port.")] = 115200,
    wheel_base: Annotated[
        float, typer.Option(parser=MILLIMETRES, min=1, max=100000, help="True wheel base, mm.")
    ] = 243.0,
    slip: Annotated[
        float,
        typer.Option(min=-1, max=1, help="Slip: share of the wheel travel that does not rotate the robot."),
    ] = 0.01,
    slip_noise: Annotated[
        float, typer.Option(min=0, max=1, help="Standard deviation of the slip's variation.")
    ] = 0.002,
    encoder_noise: Annotated[float, typer.Option(min=0, max=10000, help="Counts.")] = 0.5,
    first_count: Annotated[
        int, typer.Option(min=-2147483648, max=2147483648, help="Initial encoder count.")
    ] = 32_000,
    mode_offset: Annotated[int, typer.Option(min=-255, max=255, help="Value added to packet 35.")] = 0,
    charge: Annotated[int, typer.Option(min=-100, max=1000, help="Battery charge, per cent.")] = 90,
    on_charger: Annotated[
        bool, typer.Option("--on-charger", help="The robot is on its charging base.")
    ] = False,
    asleep: Annotated[bool, typer.Option("--asleep", help="The robot sleeps; BRC wakes it.")] = False,
    event: Annotated[
        str | None,
        typer.Option(help="bump, wheel-drop, cliff or charger @SECONDS after it starts to rotate."),
    ] = None,
    truth: _Truth = 0,
    seed: options.Seed = 0,
) -> Result:
    """Emulate a Roomba until stopped; its true angle is served on UDP for an emulated radar.

    Example: tagid emulate roomba --pty
    """
    from tagid.motion.emulation.body import BodySettings
    from tagid.motion.emulation.roomba import RoombaHost, World

    if pty and ble:
        raise UsageError("--pty and --ble are both given", "Choose one.")
    body = BodySettings(
        wheel_base_mm=wheel_base,
        slip=slip,
        slip_noise=slip_noise,
        encoder_noise=encoder_noise,
        first_count=first_count,
        seed=seed,
    )
    world = World(on_charger=on_charger, mode_offset=mode_offset)
    world.charge = round(world.capacity * max(0, min(100, charge)) / 100)
    with RoombaHost(body, world, baud, asleep, event, truth, link) as host:
        if not ble:
            facts = {"url": f"roomba+serial://{link or host.port.path}", "truth": host.truth.address}
            _wait(terminal, "emulate roomba", facts, host.port.worker, host.truth.worker)
        else:
            with _bridge_before(host, name, passkey) as (hci, brc):
                url = f"roomba+ble://{name}?hci={hci}" + (f"&passkey={passkey}" if passkey else "")
                facts = {"url": url, "truth": host.truth.address}
                _wait(terminal, "emulate roomba", facts, host.port.worker, host.truth.worker, brc)
    raise typer.Exit(0)


@command("emulate comxim")
def comxim(
    terminal: Terminal,
    link: Annotated[Path | None, typer.Option(help="Symbolic link to create for the port.")] = None,
    rate_error: _RateError = 0.03,
    fail: Annotated[
        int | None, typer.Option(min=0, max=2147483648, help="Error code returned by CT+RUN.")
    ] = None,
    truth: _Truth = 0,
) -> Result:
    """Emulate a Comxim turntable on a pseudo-terminal until stopped.

    Example: tagid emulate comxim
    """
    from tagid.motion.emulation.pty import PtyPort
    from tagid.motion.emulation.table import ComximCore
    from tagid.motion.emulation.truth import TruthServer

    core = ComximCore(rate_error, time.monotonic(), fail)
    with PtyPort(core, link) as port, TruthServer(core.table.state, truth) as server:
        facts = {"url": f"comxim+serial://{link or port.path}", "truth": server.address}
        _wait(terminal, "emulate comxim", facts, port.worker, server.worker)
    raise typer.Exit(0)


@command("emulate revopoint")
def revopoint(terminal: Terminal, rate_error: _RateError = 0.02, truth: _Truth = 0) -> Result:
    """Emulate a Revopoint dual-axis table on a virtual Bluetooth controller until stopped.

    Example: tagid emulate revopoint
    """
    from tagid.motion.discovery import REVOPOINT
    from tagid.motion.emulation.gatt import GattPort
    from tagid.motion.emulation.table import RevopointCore
    from tagid.motion.emulation.truth import TruthServer
    from tagid.motion.tables.revopoint import CHARACTERISTIC, SERVICE

    core = RevopointCore(rate_error, time.monotonic())
    with (
        GattPort(core, REVOPOINT, SERVICE, CHARACTERISTIC) as port,
        TruthServer(core.table.state, truth) as server,
    ):
        facts = {"url": f"revopoint+ble://?hci={port.hci}", "truth": server.address}
        _wait(terminal, "emulate revopoint", facts, port.worker, server.worker)
    raise typer.Exit(0)


def _wait(terminal: Terminal, name: str, facts: dict[str, Any], *workers: Worker) -> None:
    """Print where the emulator listens, and wait for a stop signal. Raises DeviceError if a thread dies."""
    from tagid.motion.emulation.pty import raise_failure

    stop = threading.Event()
    with interrupts.asked_to_stop(stop.set):
        true = f"true angle at {facts['truth']}: turned_by of an emulated radar"
        _listens(terminal, name, facts, "tagid motion info --motion {}", true)
        while not stop.wait(_LOOK_S):
            for worker in workers:
                raise_failure(worker)


def _listens(
    terminal: Terminal, name: str, facts: dict[str, Any], command: str, remark: str | None = None
) -> None:
    """Print where an emulator listens, with other facts and the next command, which has {} for the URL."""
    shown = [f"{key} {value}" for key, value in facts.items() if key not in ("url", "truth", "object")]
    shown += [] if remark is None else [remark]
    shown.append(f"next, in another terminal: {next_command(str(facts['url']), command)}")
    announce(
        terminal, name, facts, [f"{name.partition(' ')[2]} emulator (stop it with Ctrl-C) listens at"], shown
    )


BRC_PIN = 6


@contextmanager
def _bridge_before(host: RoombaHost, name: str, passkey: str | None) -> Iterator[tuple[str, Worker]]:
    """A bridge connected to the robot's UART and BRC pin; yields its controller's address and its thread.

    Raises MissingExtraError, UsageError.
    """
    from tagid.motion.ble import virtual_bluetooth

    board_process = virtual_bluetooth("board")
    if passkey is not None and not (len(passkey) == 6 and passkey.isdecimal()):
        raise UsageError("the pass-key is not six digits", "Give --passkey 123456.")
    config: dict[str, Any] = {
        "name": name,
        "passkey": passkey,
        "uart_tx": 4,
        "uart_rx": 5,
        "brc_pin": BRC_PIN,
        "index_pin": 7,
    }
    with board_process(config, host.port.path) as board:

        def watch_brc() -> None:
            while True:
                try:
                    change = board.wait_for("pin")
                except DeviceError:
                    if board.process.poll() is not None:
                        raise
                    continue
                if change.get("pin") == BRC_PIN and not change.get("value"):
                    with host.port.lock:
                        host.core.pulse_brc()

        worker = Worker(watch_brc, "brc")
        worker.start()
        yield board.hci, worker


_MOST_TRUTH_BYTES = 64 * 1024


def read_truth(path: Path) -> ObjectInfo:
    """The object in a file of `tagid emulate p440 --truth FILE`. Raises StorageError, FileFormatError."""
    from tagid.files import read_bytes
    from tagid.metadata import ObjectInfo

    try:
        values = json.loads(read_bytes(path, _MOST_TRUTH_BYTES))
        if not isinstance(values, dict):
            raise ValueError("not an object")
        return ObjectInfo.from_json(values)
    except (ValueError, RecursionError, DataError) as error:
        raise FileFormatError(
            f"{path}: is not a truth file ({str(error)[:120]})",
            "Give a file written by `tagid emulate p440 --truth FILE`.",
        ) from None


def is_truth(path: Path) -> bool:
    """Whether a file is one that `tagid emulate p440 --truth FILE` wrote."""
    try:
        return read_truth(path).truth is not None
    except (FileFormatError, StorageError):
        return False
