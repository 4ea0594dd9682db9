"""`tagid emulate p440`: an emulated radar on a real interface."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import emulate_motion
from tagid.cli.frame import Terminal, command
from tagid.cli.options import SceneOptions
from tagid.cli.outputs import check_own
from tagid.cli.truth import is_truth
from tagid.cli.units import PICOSECONDS
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.metadata import ObjectInfo
    from tagid.radar.emulation.sources import ScanSource
    from tagid.radar.emulation.wires import PtyWire

DEFAULT_SCENE = "helmet-120"
WITH_REPLAY = ("seed", "rpm", "axis_distance", "snr")
"""Options that may be given beside --replay."""


@dataclass(frozen=True)
class _SceneOptions(SceneOptions):
    scene: Annotated[
        str | None,
        typer.Option(
            "--scene", help="An enrolled layout, points-3, can, empty ...", show_default=DEFAULT_SCENE
        ),
    ] = None
    rpm: Annotated[
        float, typer.Option("--rpm", min=-10000, max=10000, help="Speed of the emulated table, rpm.")
    ] = 2.0
    turned_by: Annotated[
        str | None,
        typer.Option("--turned-by", help="HOST:PORT of an emulated robot that rotates the object."),
    ] = None
    antenna_height_file: Annotated[
        Path | None,
        typer.Option(
            "--antenna-height-file", help="File with the antenna's height in metres, read before every scan."
        ),
    ] = None
    budget: Annotated[
        bool, typer.Option("--budget", help="Noise from the radar equation of `tagid plan`; replaces --snr.")
    ] = False
    cable_delay: Annotated[
        float,
        typer.Option(
            "--cable-delay", parser=PICOSECONDS, min=-1e07, max=1e07, help="Delay of the emulated cables, ps."
        ),
    ] = 0.0


@dataclass(frozen=True)
class _WireOptions:
    bind: Annotated[str, typer.Option("--bind", help="HOST:PORT to listen on; port 0: any free port.")] = (
        "127.0.0.1:21210"
    )
    serial: Annotated[bool, typer.Option("--serial", help="Use a serial port instead of UDP.")] = False
    framing: Annotated[str, typer.Option("--framing", help="Framing on the serial port: usb or uart.")] = (
        "usb"
    )
    baud: Annotated[
        int, typer.Option("--baud", min=0, max=10000000, help="Baud rate of the uart; 0: unlimited.")
    ] = 115200
    link: Annotated[Path | None, typer.Option("--link", help="Symbolic link to create for the port.")] = None


@dataclass(frozen=True)
class _FaultOptions:
    lose: Annotated[
        float | None,
        typer.Option(
            "--lose", min=0, max=1, help="Share of packets lost.", show_default="0, or that of --rig"
        ),
    ] = None
    duplicate: Annotated[
        float, typer.Option("--duplicate", min=0, max=1, help="Share of packets sent twice.")
    ] = 0.0
    reorder: Annotated[float, typer.Option("--reorder", min=0, max=1, help="Share of packets reordered.")] = (
        0.0
    )
    delay: Annotated[float, typer.Option("--delay", min=0, max=1, help="Share of packets delayed.")] = 0.0
    delay_ms: Annotated[
        float, typer.Option("--delay-ms", min=0, max=60000, help="Delay of those packets, milliseconds.")
    ] = 20.0


@command("emulate p440")
def p440(
    terminal: Terminal,
    wire: _WireOptions,
    scene: _SceneOptions,
    faulty: _FaultOptions,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="File for the true pose, to be read by scan --truth.")
    ] = None,
    replay: Annotated[str | None, typer.Option("--replay", help="Replay a recording instead.")] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat the recording endlessly.")] = False,
    rate: Annotated[
        float, typer.Option("--rate", min=0, max=1e06, help="Time factor; 0: as fast as possible.")
    ] = 1.0,
    status_bytes: Annotated[
        int,
        typer.Option("--status-bytes", min=0, max=1000, help="Status size: 64, or 32 as in old firmware."),
    ] = 64,
    sleep_bytes: Annotated[
        int, typer.Option("--sleep-bytes", min=0, max=1000, help="Size of the sleep confirmation: 12 or 8.")
    ] = 12,
    server: Annotated[
        bool, typer.Option("--server", help="Also act as the vendor's server program.")
    ] = False,
) -> Result:
    """Emulate a P440 on UDP, or on a serial port whose path is printed, until stopped.

    Example: tagid emulate p440 --bind 127.0.0.1:21210 --scene helmet-120 --rpm 2
    """
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
    host, port = ("", 0) if wire.serial else _address(wire.bind)
    source, about, remark = _source(scene, replay, loop)
    if truth is not None:
        _write_truth(truth, about)
    rpm = scene.rpm if rig is None else 60 / rig.period_s
    core = EmulatorCore(source, identity=None if rig is None else rig.identity, firmware=firmware)
    stop = threading.Event()
    run = f"tagid scan --radar {{}} --axis-distance {scene.axis_distance:g}"
    run += f" --motion 'free?rpm={rpm:.4g}'" if rpm > 0 else ""
    facts: dict[str, Any] = {} if about is None else {"object": about.to_json()}

    def listens(url: str, **more: str) -> None:
        emulate_motion.announce(terminal, "emulate p440", {"url": url, **more, **facts}, run, remark)

    with interrupts.asked_to_stop(stop.set):
        if wire.serial:
            pty = _pty(wire)
            end = wire.link or pty.path
            listens(f"serial://{end}{'?framing=uart' * (wire.framing == 'uart')}", port=str(end))
            serve(core, pty, ServeOptions(rate=rate, faults=faults), stop)
        else:
            udp = ServeOptions(host, port, rate, faults)
            serve_udp(core, udp, stop, lambda a, p: listens(f"udp://{a}:{p}"))
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


def _address(bind: str) -> tuple[str, int]:
    host, _, port = bind.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"--bind is {bind!r}", "Give HOST:PORT, e.g. 127.0.0.1:21210.")
    return host, int(port)


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


def _write_truth(path: Path, about: ObjectInfo | None) -> None:
    """Write the emulated scene, with its true pose, as JSON. Raises UsageError for a recording."""
    from tagid.files import write_bytes

    if about is None:
        raise UsageError("--truth with --replay: a recording has no known pose", "Omit one of them.")
    write_bytes(path, (json.dumps(about.to_json(), indent=1) + "\n").encode())
