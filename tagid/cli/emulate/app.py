"""`tagid emulate`: emulated devices on real interfaces."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli.common import options, response_options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_own
from tagid.cli.common.truth import is_truth
from tagid.cli.emulate import motion as emulate_motion
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.metadata import ObjectInfo
    from tagid.radar.emulation.wires import PtyWire
    from tagid.simulate import Placement, TurningScene

DEFAULT_SCENE = "helmet-120"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(
        help="Emulate a device on a real network, serial or Bluetooth interface.", no_args_is_help=True
    )
    app.add_typer(group, name="emulate")

    @group.callback()
    def _group() -> None:
        """Emulate a device on a real network, serial or Bluetooth interface."""

    emulate_motion.register(group)

    @command(group, "emulate p440")
    def p440(
        terminal: Terminal,
        bind: Annotated[
            str, typer.Option("--bind", help="HOST:PORT to listen on; port 0: any free port.")
        ] = ("127.0.0.1:21210"),
        serial: Annotated[bool, typer.Option("--serial", help="Use a serial port instead of UDP.")] = False,
        framing: Annotated[
            str, typer.Option("--framing", help="Framing on the serial port: usb or uart.")
        ] = "usb",
        baud: Annotated[
            int, typer.Option("--baud", min=0, max=10000000, help="Baud rate of the uart; 0: unlimited.")
        ] = 115200,
        link: Annotated[Path | None, typer.Option("--link", help="Symbolic link to create for the port.")] = (
            None
        ),
        scene: Annotated[
            str | None,
            typer.Option(
                "--scene", help="An enrolled layout, points-3, can, empty ...", show_default=DEFAULT_SCENE
            ),
        ] = None,
        file: options.LayoutFile = None,
        response: response_options.ResponseFile = None,
        polarisation: response_options.Polarisation = None,
        snr_reference: response_options.SnrReference = None,
        snr_reference_body: response_options.SnrReferenceBody = None,
        rotation: Annotated[
            float,
            typer.Option(
                "--rotation", min=-1e06, max=1e06, help="Rotation of the object at the start, degrees."
            ),
        ] = 0.0,
        wobble: Annotated[
            float, typer.Option("--wobble", min=-1, max=1, help="Variation of the speed; 0.01 is 1 %.")
        ] = 0.0,
        truth: Annotated[
            Path | None,
            typer.Option("--truth", help="File for the true pose, to be read by scan --truth."),
        ] = None,
        replay: Annotated[str | None, typer.Option("--replay", help="Replay a recording instead.")] = None,
        rpm: Annotated[
            float, typer.Option("--rpm", min=-10000, max=10000, help="Speed of the emulated table, rpm.")
        ] = 2.0,
        turned_by: Annotated[
            str | None,
            typer.Option("--turned-by", help="HOST:PORT of an emulated robot that rotates the object."),
        ] = None,
        axis_distance: Annotated[
            float, typer.Option("--axis-distance", min=-1e06, max=1e06, help="Radar to axis, metres.")
        ] = 1.0,
        antenna_height_file: Annotated[
            Path | None,
            typer.Option(
                "--antenna-height-file",
                help="File with the antenna's height in metres, read before every scan.",
                show_default=False,
            ),
        ] = None,
        body: options.Body = None,
        reflector: options.Reflector = None,
        elevation: options.Elevation = "0m",
        centre: options.ObjectCentre = "0,0",
        budget: Annotated[
            bool,
            typer.Option("--budget", help="SNR from the radar equation of `tagid plan`; replaces --snr."),
        ] = False,
        snr: Annotated[
            float,
            typer.Option(
                "--snr",
                min=-10000,
                max=10000,
                help="Ratio of the strongest reflector's peak to the noise of one sample, dB.",
            ),
        ] = 20.0,
        cable_delay: Annotated[
            float,
            typer.Option("--cable-delay", min=-1e07, max=1e07, help="Delay of the emulated cables, ps."),
        ] = 0.0,
        rate: Annotated[
            float, typer.Option("--rate", min=0, max=1e06, help="Time factor; 0: as fast as possible.")
        ] = 1.0,
        loop: Annotated[bool, typer.Option("--loop", help="Repeat the recording endlessly.")] = False,
        lose: Annotated[float, typer.Option("--lose", min=0, max=1, help="Share of packets lost.")] = 0.0,
        duplicate: Annotated[
            float, typer.Option("--duplicate", min=0, max=1, help="Share of packets sent twice.")
        ] = 0.0,
        reorder: Annotated[
            float, typer.Option("--reorder", min=0, max=1, help="Share of packets reordered.")
        ] = 0.0,
        delay: Annotated[
            float, typer.Option("--delay", min=0, max=1, help="Share of packets delayed.")
        ] = 0.0,
        delay_ms: Annotated[
            float, typer.Option("--delay-ms", min=0, max=60000, help="Delay of those packets, milliseconds.")
        ] = 20.0,
        status_bytes: Annotated[
            int,
            typer.Option(
                "--status-bytes", min=0, max=1000, help="Status size: 64, or 32 as in old firmware."
            ),
        ] = 64,
        sleep_bytes: Annotated[
            int,
            typer.Option("--sleep-bytes", min=0, max=1000, help="Size of the sleep confirmation: 12 or 8."),
        ] = 12,
        server: Annotated[
            bool, typer.Option("--server", help="Also act as the vendor's server program.")
        ] = False,
        seed: Annotated[
            int,
            typer.Option(
                "--seed",
                help="Random seed of the recording and of the object: also where a handle or seam is.",
                min=0,
            ),
        ] = 0,
    ) -> Result:
        """Emulate a P440 on UDP, or on a serial port whose path is printed, until stopped.

        Example: tagid emulate p440 --bind 127.0.0.1:21210 --scene helmet-120 --rpm 2
        """
        from tagid.motion.emulation.truth import TrueAngle
        from tagid.radar.emulation.core import EmulatorCore
        from tagid.radar.emulation.emulator import ServeOptions, serve, serve_udp
        from tagid.radar.emulation.faults import Faults
        from tagid.radar.emulation.firmware import Firmware
        from tagid.radar.emulation.sources import ScanSource
        from tagid.recording.sources import emulated_recording, emulated_scene
        from tagid.simulate import Acquisition, Wobble
        from tagid.simulate.source import NOISE_INDEX

        if truth is not None:
            check_own(truth, is_truth, "a truth file")
        faults = Faults(
            lose=lose, duplicate=duplicate, reorder=reorder, delay=delay, delay_s=delay_ms * 1e-3, seed=seed
        )
        firmware = Firmware(status_bytes, sleep_bytes, server)
        host, port = ("", 0) if serial else _address(bind)
        files = response_options.response_files(response, polarisation, snr_reference, snr_reference_body)
        if replay is not None and files is not None:
            raise UsageError("--replay and --response are both given", "Choose one.")
        if antenna_height_file is not None and (replay is not None or files is not None):
            raise UsageError(
                "--antenna-height-file with --replay or --response: that antenna cannot be moved",
                "Use --scene.",
            )
        given = {"--scene": scene is not None, "--file": file is not None, "--body": body is not None}
        given |= {"--reflector": reflector is not None, "--budget": budget}
        if files is not None:
            response_options.check_with_response(given)
        if replay is not None:
            given |= {"--elevation": elevation != "0m", "--centre": centre != "0,0"}
            given |= {"--rotation": rotation != 0, "--wobble": wobble != 0, "--turned-by": bool(turned_by)}
            given["--cable-delay"] = cable_delay != 0
            response_options.check_scene_options("--replay", "a recording is sent as it is", given)
        source: ScanSource
        about: ObjectInfo | None = None
        remark: str | None = None
        turning: TurningScene | None = None
        if replay is not None:
            source = emulated_recording(Path(replay), loop)
        elif files is not None:
            placed = Acquisition(
                axis_distance_m=axis_distance,
                snr_db=snr,
                placement=_placement(centre, rotation, elevation),
                wobble=Wobble(speed=wobble),
            )
            turner = TrueAngle(turned_by).at if turned_by else None
            turning = files.turning(placed, rpm, seed, cable_delay * 1e-12, turner)
        else:
            wanted = {"seed": seed, "rpm": rpm, "axis_distance": axis_distance, "snr": snr}
            wanted |= {"cable_delay": cable_delay, "rotation": rotation, "wobble": wobble}
            texts = {key: str(value) for key, value in wanted.items()}
            texts |= {"centre": centre, "elevation": elevation, "budget": "1" if budget else "0"}
            chosen = {"body": body, "reflector": reflector, "turned_by": turned_by}
            chosen["file"] = None if file is None else str(file)
            chosen["antenna_height_file"] = None if antenna_height_file is None else str(antenna_height_file)
            texts |= {key: text for key, text in chosen.items() if text}
            turning = emulated_scene(scene or DEFAULT_SCENE, texts)
        if turning is not None:
            source, about = turning, turning.about()
            remark = f"{turning.snr} at integration index {NOISE_INDEX}"
        if truth is not None:
            _write_truth(truth, about)
        core = EmulatorCore(source, firmware=firmware)
        stop = threading.Event()
        run = f"tagid scan --radar {{}} --axis-distance {axis_distance:g}"
        run += f" --motion 'free?rpm={rpm:g}'" if rpm > 0 else ""
        facts: dict[str, Any] = {} if about is None else {"object": about.to_json()}

        def listens(url: str, **more: str) -> None:
            emulate_motion.announce(terminal, "emulate p440", {"url": url, **more, **facts}, run, remark)

        with interrupts.asked_to_stop(stop.set):
            if serial:
                wire = _pty(framing, baud, link)
                end = link or wire.path
                listens(f"serial://{end}{'?framing=uart' * (framing == 'uart')}", port=str(end))
                serve(core, wire, ServeOptions(rate=rate, faults=faults), stop)
            else:
                udp = ServeOptions(host, port, rate, faults)
                serve_udp(core, udp, stop, lambda a, p: listens(f"udp://{a}:{p}"))
        raise typer.Exit(0)


def _address(bind: str) -> tuple[str, int]:
    host, _, port = bind.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"--bind is {bind!r}", "Give HOST:PORT, e.g. 127.0.0.1:21210.")
    return host, int(port)


def _placement(centre: str, rotation: float, elevation: str) -> Placement:
    import numpy as np

    from tagid.cli.common.points import parse_point
    from tagid.simulate import Placement, parse_elevation

    turned = float(np.deg2rad(rotation))
    return Placement(parse_point("--centre", centre), turned, parse_elevation(elevation))


def _pty(framing: str, baud: int, link: Path | None) -> PtyWire:
    from tagid.radar.emulation.wires import PtyWire
    from tagid.radar.framing import Framing
    from tagid.radar.serial_link import BAUD_RATES

    if framing not in ("usb", "uart"):
        raise UsageError(f"--framing is {framing!r}", "Give usb or uart.")
    if baud and baud not in BAUD_RATES:
        raise UsageError(f"--baud is {baud}", "Give 9600 to 921600, or 0 for no limit.")
    return PtyWire(Framing(framing), baud if framing == "uart" and baud else None, link)


def _write_truth(path: Path, about: ObjectInfo | None) -> None:
    """Write the emulated scene, with its true pose, as JSON. Raises UsageError for a recording."""
    from tagid.files import write_bytes

    if about is None:
        raise UsageError("--truth with --replay: a recording has no known pose", "Omit one of them.")
    write_bytes(path, (json.dumps(about.to_json(), indent=1) + "\n").encode())
