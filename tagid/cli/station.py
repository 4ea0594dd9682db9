"""`tagid station`: a web page to operate scans from a browser."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Terminal, announce, command
from tagid.cli.options import SECONDS
from tagid.result import Result

_OPEN = "open this address in a browser; stop with Ctrl-C"


@command("station")
def station(
    terminal: Terminal,
    bind: Annotated[
        str, typer.Option(help="HOST:PORT to listen on; other computers need a pairing code.")
    ] = "127.0.0.1:8440",
    radar: options.RadarUrl = None,
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    save_dir: Annotated[Path | None, typer.Option(help="Folder for the files.")] = None,
    max_seconds: Annotated[float, typer.Option(parser=SECONDS, help="Longest recording.")] = 180.0,
    demo: Annotated[
        bool, typer.Option("--demo", help="Use an emulated radar, a helmet, and an object to enroll.")
    ] = False,
    demo_scene: Annotated[str, typer.Option(help="Scene of the demo.")] = "helmet-120",
) -> Result:
    """Serve a web page with a Scan button, live image, answer, health and history.

    Example: tagid station --demo
    """
    from tagid.operate.workplace import Workplace
    from tagid.station.demo import DemoObject, demo_objects
    from tagid.station.security import is_loopback
    from tagid.station.server import Server
    from tagid.station.station import Source, Station

    host, port = options.parse_bind(bind, "127.0.0.1:8440")
    overrides: dict[str, Any] = {
        "radar.url": radar,
        "motion.url": motion,
        "motion.axis_distance_m": axis_distance,
        "storage.folder": None if save_dir is None else str(save_dir),
    }

    def show_code(code: str) -> None:
        with suppress(OSError):  # the terminal may be gone
            typer.echo(f"pairing code: {code}", err=True)

    objects: tuple[DemoObject, ...] = ()
    if demo:
        settings = options.demo_settings(demo_scene, overrides)
        overrides |= settings
        objects = demo_objects(demo_scene, settings)
    source = Source(lambda: Workplace(overrides), max_seconds, objects)
    source.place()
    with Server(Station(source), host, port, None if is_loopback(host) else show_code) as server:
        announce(terminal, "station", {"url": server.url}, (), [_OPEN])
        stop = threading.Event()
        with interrupts.asked_to_stop(stop.set):
            while server.running and not stop.wait(0.5):
                pass
        if server.failure is not None:
            raise server.failure
    raise typer.Exit(0)
