"""`tagid station`: a web page to operate scans from a browser."""

from __future__ import annotations

import json
import sys
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Output, Terminal, command
from tagid.cli.options import demo_settings
from tagid.cli.units import SECONDS
from tagid.errors import UsageError
from tagid.result import Result


@command("station")
def station(
    terminal: Terminal,
    bind: Annotated[
        str, typer.Option("--bind", help="HOST:PORT to listen on; other computers need a pairing code.")
    ] = "127.0.0.1:8440",
    radar: options.RadarUrl = None,
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the files.")] = None,
    max_seconds: Annotated[
        float, typer.Option("--max-seconds", parser=SECONDS, help="Longest recording.")
    ] = 180.0,
    demo: Annotated[
        bool, typer.Option("--demo", help="Use an emulated radar, a helmet, and an object to enroll.")
    ] = False,
    demo_scene: Annotated[str, typer.Option("--demo-scene", help="Scene of the demo.")] = "helmet-120",
) -> Result:
    """Serve a web page with a Scan button, live image, answer, health and history.

    Example: tagid station --demo
    """
    from tagid.operate.workplace import Workplace
    from tagid.station.demo import DemoObject, demo_objects
    from tagid.station.security import is_loopback
    from tagid.station.server import Server
    from tagid.station.station import Source, Station

    host, port = _address(bind)
    overrides: dict[str, Any] = {
        "radar.url": radar,
        "motion.url": motion,
        "motion.axis_distance_m": axis_distance,
        "storage.folder": None if save_dir is None else str(save_dir),
    }

    def announce(code: str) -> None:
        with suppress(OSError):  # the terminal may be gone
            typer.echo(f"pairing code: {code}", err=True)

    with ExitStack() as stack:
        objects: tuple[DemoObject, ...] = ()
        if demo:
            settings = demo_settings(demo_scene, overrides)
            overrides |= settings
            objects = demo_objects(demo_scene, settings)
        source = Source(lambda: Workplace(overrides), max_seconds, objects)
        source.place()
        work = Station(source)
        away = None if is_loopback(host) else announce
        server = stack.enter_context(Server(work, host, port, away))
        _announce(terminal, server.url)
        stop = threading.Event()
        with interrupts.asked_to_stop(stop.set):
            while server.running and not stop.wait(0.5):
                pass
        if server.failure is not None:
            raise server.failure
    raise typer.Exit(0)


def _address(bind: str) -> tuple[str, int]:
    host, _, port = bind.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise UsageError(f"--bind is {bind!r}", "Give HOST:PORT, e.g. 127.0.0.1:8440.")
    return host.removeprefix("[").removesuffix("]"), int(port)


def _announce(terminal: Terminal, url: str) -> None:
    """Print the address immediately, because the user needs it while the station runs."""
    if terminal.output is Output.json:
        sys.stdout.write(json.dumps(Result("station", {"url": url}).envelope()) + "\n")
    else:
        sys.stdout.write(f"{url}\n")
    sys.stdout.flush()
    if terminal.output is Output.human and not terminal.quiet:
        typer.echo("open this address in a browser; stop with Ctrl-C", err=True)
