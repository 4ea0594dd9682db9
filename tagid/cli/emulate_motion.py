"""`tagid emulate roomba`, `comxim` and `revopoint`: emulated robots and turntables on real interfaces."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Output, Terminal, command, next_command
from tagid.cli.units import MILLIMETRES
from tagid.errors import DeviceError, UsageError
from tagid.result import Result
from tagid.workers import Worker

if TYPE_CHECKING:
    from tagid.motion.emulation.host import RoombaHost

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
    link: Annotated[Path | None, typer.Option("--link", help="Symbolic link to create for the port.")] = None,
    name: Annotated[str, typer.Option("--name", help="Name of the bridge.")] = "tagid-bridge",
    passkey: Annotated[
        str | None, typer.Option("--passkey", help="Pass-key, six digits; omit for an open bridge.")
    ] = None,
    baud: Annotated[int, typer.Option("--baud", min=0, max=10000000, help="Baud rate of the port.")] = 115200,
    wheel_base: Annotated[
        float,
        typer.Option("--wheel-base", parser=MILLIMETRES, min=1, max=100000, help="True wheel base, mm."),
    ] = 243.0,
    slip: Annotated[
        float,
        typer.Option(
            "--slip", min=-1, max=1, help="Slip: share of the wheel travel that does not rotate the robot."
        ),
    ] = 0.01,
    slip_noise: Annotated[
        float, typer.Option("--slip-noise", min=0, max=1, help="Standard deviation of the slip's variation.")
    ] = 0.002,
    encoder_noise: Annotated[float, typer.Option("--encoder-noise", min=0, max=10000, help="Counts.")] = 0.5,
    first_count: Annotated[
        int, typer.Option("--first-count", min=-2147483648, max=2147483648, help="Initial encoder count.")
    ] = 32_000,
    mode_offset: Annotated[
        int, typer.Option("--mode-offset", min=-255, max=255, help="Value added to packet 35.")
    ] = 0,
    charge: Annotated[
        int, typer.Option("--charge", min=-100, max=1000, help="Battery charge, per cent.")
    ] = 90,
    on_charger: Annotated[
        bool, typer.Option("--on-charger", help="The robot is on its charging base.")
    ] = False,
    asleep: Annotated[bool, typer.Option("--asleep", help="The robot sleeps; BRC wakes it.")] = False,
    event: Annotated[
        str | None,
        typer.Option(
            "--event", help="bump, wheel-drop, cliff or charger @SECONDS after it starts to rotate."
        ),
    ] = None,
    truth: _Truth = 0,
    seed: options.Seed = 0,
) -> Result:
    """Emulate a Roomba until stopped; its true angle is served on UDP for an emulated radar.

    Example: tagid emulate roomba --pty
    """
    from tagid.motion.emulation.body import BodySettings
    from tagid.motion.emulation.host import RoombaHost
    from tagid.motion.emulation.roomba import World

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
            serve(terminal, "emulate roomba", facts, host.port.worker, host.truth.worker)
        else:
            with bridge_before(host, name, passkey) as (hci, brc):
                url = f"roomba+ble://{name}?hci={hci}" + (f"&passkey={passkey}" if passkey else "")
                facts = {"url": url, "truth": host.truth.address}
                serve(terminal, "emulate roomba", facts, host.port.worker, host.truth.worker, brc)
    raise typer.Exit(0)


@command("emulate comxim")
def comxim(
    terminal: Terminal,
    link: Annotated[Path | None, typer.Option("--link", help="Symbolic link to create for the port.")] = None,
    rate_error: _RateError = 0.03,
    fail: Annotated[
        int | None, typer.Option("--fail", min=0, max=2147483648, help="Error code returned by CT+RUN.")
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
        serve(terminal, "emulate comxim", facts, port.worker, server.worker)
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
        serve(terminal, "emulate revopoint", facts, port.worker, server.worker)
    raise typer.Exit(0)


def serve(terminal: Terminal, name: str, facts: dict[str, Any], *workers: Worker) -> None:
    """Print where the emulator listens, and wait for a stop signal. Raises DeviceError if a thread dies."""
    from tagid.motion.emulation.pty import raise_failure

    stop = threading.Event()
    with interrupts.asked_to_stop(stop.set):
        announce(terminal, name, facts, "tagid motion info --motion {}")
        while not stop.wait(_LOOK_S):
            for worker in workers:
                raise_failure(worker)


def announce(
    terminal: Terminal, name: str, facts: dict[str, Any], command: str, remark: str | None = None
) -> None:
    """Print immediately where an emulator listens, because the user needs it while it runs.

    As JSON it is one line; as text the URL is on a line of its own on stdout, the rest on stderr.

    Args:
        terminal: the output.
        name: of the command.
        facts: `url` and more.
        command: the next command, with {} for the URL.
        remark: one more line of text about the object.
    """
    if terminal.output is Output.json:
        sys.stdout.write(json.dumps(Result(name, facts).envelope()) + "\n")
        sys.stdout.flush()
        return
    if not terminal.quiet:
        typer.echo(f"{name.partition(' ')[2]} emulator (stop it with Ctrl-C) listens at", err=True)
    sys.stdout.write(f"{facts['url']}\n")
    sys.stdout.flush()
    if not terminal.quiet:
        for key, value in facts.items():
            if key not in ("url", "truth", "object"):
                typer.echo(f"{key} {value}", err=True)
        if remark is not None:
            typer.echo(remark, err=True)
        typer.echo(f"next, in another terminal: {next_command(str(facts['url']), command)}", err=True)


BRC_PIN = 6


@contextmanager
def bridge_before(host: RoombaHost, name: str, passkey: str | None) -> Iterator[tuple[str, Worker]]:
    """A bridge connected to the robot's UART and BRC pin; yields its controller's address and its thread.

    Raises MissingExtraError, UsageError.
    """
    from tagid.motion.links import require

    require("bumble", "virtual", "an emulated bridge")
    from tagid.motion.virtual import virtual_bluetooth

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
