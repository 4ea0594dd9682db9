"""`tagid emulate`: devices that are not there, on real wires."""

from __future__ import annotations

import json
import signal
import sys
import threading
from typing import Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Output, Terminal, command
from tagid.errors import UsageError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Emulate a device on a real wire.", no_args_is_help=True)
    app.add_typer(group, name="emulate")

    @group.callback()
    def _group() -> None:
        """Emulate a device on a real wire."""

    @command(group, "emulate p440")
    def p440(
        terminal: Terminal,
        bind: Annotated[str, typer.Option("--bind", help="HOST:PORT to listen on; 0 any free port.")] = (
            "127.0.0.1:21210"
        ),
        scene: Annotated[str, typer.Option("--scene", help="helmet-120, points-3, can, empty ...")] = (
            "helmet-120"
        ),
        replay: Annotated[str | None, typer.Option("--replay", help="Replay a recording instead.")] = None,
        rpm: Annotated[float, typer.Option("--rpm", help="Turns a minute of the emulated table.")] = 2.0,
        axis_distance: Annotated[float, typer.Option("--axis-distance", help="Radar to axis, metres.")] = 1.0,
        snr: Annotated[float, typer.Option("--snr", help="dB a sample of a reflector on the axis.")] = 20.0,
        rate: Annotated[float, typer.Option("--rate", help="Speed of time; 0 as fast as taken.")] = 1.0,
        loop: Annotated[bool, typer.Option("--loop", help="Replay for ever.")] = False,
        lose: Annotated[float, typer.Option("--lose", help="Share of packets lost.")] = 0.0,
        duplicate: Annotated[float, typer.Option("--duplicate", help="Share of packets sent twice.")] = 0.0,
        reorder: Annotated[float, typer.Option("--reorder", help="Share of packets held back.")] = 0.0,
        delay: Annotated[float, typer.Option("--delay", help="Share of packets that come late.")] = 0.0,
        delay_ms: Annotated[float, typer.Option("--delay-ms", help="How late, milliseconds.")] = 20.0,
        seed: options.Seed = 0,
    ) -> Result:
        """Be a P440 on UDP until stopped.

        Example: tagid emulate p440 --bind 127.0.0.1:21210 --scene helmet-120 --rpm 2
        """
        from pathlib import Path

        from tagid.radar.emulator import ServeOptions, serve_udp
        from tagid.radar.emulator_core import EmulatorCore
        from tagid.radar.faults import Faults
        from tagid.radar.sources import ScanSource
        from tagid.sources import Sources

        host, _, port_text = bind.rpartition(":")
        if not host or not port_text.isdecimal() or int(port_text) > 65535:
            raise UsageError(f"--bind is {bind!r}", "Give HOST:PORT, e.g. 127.0.0.1:21210.")
        faults = Faults(
            lose=lose, duplicate=duplicate, reorder=reorder, delay=delay, delay_s=delay_ms * 1e-3, seed=seed
        )
        source: ScanSource
        if replay is not None:
            source = Sources().recording(Path(replay), loop)
        else:
            wanted = {"seed": seed, "rpm": rpm, "axis_distance": axis_distance, "snr": snr}
            source = Sources().scene(scene, {key: str(value) for key, value in wanted.items()})
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())

        def ready(address: str, port: int) -> None:
            url = f"udp://{address}:{port}"
            if terminal.output is Output.json:
                # Written on one line when it listens: whoever starts it must learn its port while it runs.
                envelope = Result("emulate p440", {"url": url}).envelope()
                sys.stdout.write(json.dumps(envelope) + "\n")
                sys.stdout.flush()
            elif not terminal.quiet:
                typer.echo(f"P440 emulator at {url}, {replay or scene}; stop with Ctrl-C", err=True)

        serve_udp(EmulatorCore(source), ServeOptions(host, int(port_text), rate, faults), stop, ready)
        raise typer.Exit(0)
