"""`tagid radar`: find, query, configure, restart and monitor the radar, and record scans."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES, SECONDS
from tagid.config import Config, load_config, radar_url
from tagid.constants import CAPTURE_SUFFIX, SPEED_OF_LIGHT
from tagid.counting import counted
from tagid.errors import EXIT_DEVICE, EXIT_INTERRUPTED, EXIT_OK, UsageError
from tagid.result import Problem, Result

if TYPE_CHECKING:
    from tagid.radar.p440 import P440
    from tagid.radar.settings import RadarConfig
    from tagid.recording.long_recording import RecordingState
    from tagid.recording.monitoring import Monitor
    from tagid.result import Drawn


Seconds = Annotated[
    float | None, typer.Option("--seconds", parser=SECONDS, help="Stop after this time, seconds.")
]
Interval = Annotated[
    int,
    typer.Option(
        "--interval-us", min=0, max=4294967295, help="Microseconds between scans; 0: as fast as possible."
    ),
]


def open_configured(config: Config) -> P440:
    """The client of the configured radar, not connected yet. Raises ConfigError, UsageError, DeviceError."""
    from tagid.recording.radars import open_radar

    return open_radar(radar_url(config), config["radar.timeout_s"])


@command("radar find")
def find(
    terminal: Terminal,
    address: Annotated[
        list[str] | None, typer.Option(help="Query HOST[:PORT] instead of radar.addresses; repeatable.")
    ] = None,
    ask: Annotated[
        list[str] | None, typer.Option(help="Also query this radar URL, e.g. of a UART adapter; repeatable.")
    ] = None,
) -> Result:
    """Find radars on serial ports and at the configured addresses; takes up to 3 seconds.

    Example: tagid radar find
    """
    from tagid.cli.frame import to_copy
    from tagid.radar.discovery import WHERE_TO_LOOK, addresses_from, discover
    from tagid.report.radar import found_table

    wanted = {"radar.addresses": ",".join(address)} if address else {}
    config = load_config(wanted)
    radars = discover(addresses_from(config["radar.addresses"]), tuple(ask or ()))
    data: dict[str, Any] = {"radars": [asdict(radar) for radar in radars.radars], "asked": radars.asked}
    errors = tuple(
        Problem("device", f"{radar.url}: {radar.problem}", radar.remedy)
        for radar in radars.radars
        if radar.problem
    )
    if not radars.radars:
        message = f"no radar replied at {', '.join(radars.asked) or 'any address'} or on a USB port"
        errors = (Problem("device", message, WHERE_TO_LOOK),)
    answering = [radar.url for radar in radars.radars if radar.status]
    urls = to_copy(answering, "tagid config set radar.url {}")
    human: Drawn | None = [found_table(radars.radars), urls] if radars.radars else None
    code = EXIT_OK if answering else EXIT_DEVICE
    return Result("radar find", data, human, exit_code=code, errors=errors, completed=len(answering))


@command("radar info")
def info(terminal: Terminal, radar: options.RadarUrl = None) -> Result:
    """Show versions, serial number, temperature, self-test and settings of the radar.

    Example: tagid radar info --radar udp://192.168.1.100
    """
    from tagid.radar.survey import survey
    from tagid.report.radar import info_table

    config = load_config({"radar.url": radar})
    radar_survey = survey(open_configured(config))
    data = {"url": radar_url(config), **asdict(radar_survey)}
    table = info_table(radar_url(config), radar_survey)
    return Result("radar info", data, table, messages=tuple(radar_survey.warnings()))


@command("radar config")
def config(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    start: Annotated[
        float | None,
        typer.Option(
            parser=METRES, min=-10000, max=10000, help="Start of the window, metres from the antennas."
        ),
    ] = None,
    stop: Annotated[
        float | None,
        typer.Option(
            parser=METRES, min=-10000, max=10000, help="End of the window, metres from the antennas."
        ),
    ] = None,
    start_ps: Annotated[
        int | None,
        typer.Option(
            min=-2147483648, max=2147483647, help="The same in two-way picoseconds, including cables."
        ),
    ] = None,
    stop_ps: Annotated[int | None, typer.Option(min=-2147483648, max=2147483647, help="The same.")] = None,
    integration: Annotated[
        int | None,
        typer.Option(
            "--integration",
            "--pii",
            min=-1000,
            max=1000,
            help="Integration index, 6 to 15: 2^n pulses per sample.",
        ),
    ] = None,
    gain: Annotated[int | None, typer.Option(min=-1000, max=1000, help="Transmit gain, 0 to 63.")] = None,
    antenna_mode: Annotated[
        int | None, typer.Option(min=-1000, max=1000, help="0 A/A, 1 B/B, 2 TxA-RxB, 3 TxB-RxA.")
    ] = None,
    code_channel: Annotated[int | None, typer.Option(min=-1000, max=1000, help="0 to 10.")] = None,
    node_id: Annotated[int | None, typer.Option(min=0, max=4294967295, help="Node id of the radar.")] = None,
    save: Annotated[bool, typer.Option("--save", help="Store the settings in the radar's flash.")] = False,
    cable_delay: options.CableDelay = None,
) -> Result:
    """Show the radar's settings; change those given, and show the resulting values.

    Example: tagid radar config --start 0.5 --stop 2.5 --pii 11
    """
    settings = load_config({"radar.url": radar, "radar.cable_delay_ps": cable_delay})
    delay = float(settings["radar.cable_delay_ps"])
    wanted = {
        "scan_start_ps": _edge("start", start, start_ps, delay),
        "scan_stop_ps": _edge("stop", stop, stop_ps, delay),
        "base_integration_index": integration,
        "transmit_gain": gain,
        "antenna_mode": antenna_mode,
        "code_channel": code_channel,
        "node_id": node_id,
    }
    asked = {name: value for name, value in wanted.items() if value is not None}
    radar_url(settings)
    with open_configured(settings) as device:
        before = device.config
        taken = before
        if asked or save:
            # The settings read back may contain the flag of an earlier save; write flash only on request.
            taken = device.set_config(replace(before, **asked, persist=int(save)))
    return _result(before, asked, taken, delay)


def _edge(name: str, metres: float | None, picoseconds: int | None, delay_ps: float) -> int | None:
    """An end of the window in two-way picoseconds, cable delay included."""
    if metres is None:
        return picoseconds
    if picoseconds is not None:
        raise UsageError(f"--{name} and --{name}-ps set the same value", "Give one of them.")
    return round(2e12 * metres / SPEED_OF_LIGHT + delay_ps)


def _result(before: RadarConfig, asked: dict[str, int], taken: RadarConfig, delay_ps: float) -> Result:
    from tagid.report.radar import settings_table

    got = asdict(taken)
    other = {name: value for name, value in asked.items() if got[name] != value}
    grid = [name for name in other if name in ("scan_start_ps", "scan_stop_ps")]
    notes = []
    if grid:
        notes.append(
            "the window was aligned to the radar's grid (1.9 ps, samples in multiples of 96); the requested "
            f"window is {'inside' if _holds(asked, taken) else 'NOT inside'}"
        )
    notes += [f"the radar set {n} to {got[n]} instead of {v}" for n, v in other.items() if n not in grid]
    end = taken.range_start_m(delay_ps) + taken.samples * taken.range_step_m
    data: dict[str, Any] = {
        "before": asdict(before),
        "asked": asked,
        "taken": got,
        "window_m": [taken.range_start_m(delay_ps), end],
        "cable_delay_ps": delay_ps,
        "samples": taken.samples,
        "scan_period_s": taken.scan_period_s,
        "clip_counts": taken.clip_counts,
    }
    table = settings_table(before, asked, taken, delay_ps)
    return Result("radar config", data, table, messages=tuple(notes))


def _holds(asked: dict[str, int], taken: RadarConfig) -> bool:
    """Whether the actual window covers the requested one, to within the grid of 2 ps."""
    start = asked.get("scan_start_ps", taken.scan_start_ps)
    stop = asked.get("scan_stop_ps", taken.scan_stop_ps)
    return taken.scan_start_ps <= start and stop <= taken.scan_stop_ps + 4


@command("radar record")
def record(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Capture to write.")] = None,
    save_dir: Annotated[Path | None, typer.Option(help="Folder for the capture.")] = None,
    scans: Annotated[
        int | None, typer.Option(min=-2147483648, max=2147483648, help="Stop after this number of scans.")
    ] = None,
    seconds: Seconds = None,
    interval_us: Interval = 0,
    axis_distance: options.AxisDistance = None,
    antenna_height: options.AntennaHeight = None,
    antenna_separation: options.AntennaSeparation = None,
    cable_delay: options.CableDelay = None,
    note: Annotated[str, typer.Option(help="Text stored in the capture, e.g. a place.")] = "",
) -> Result:
    """Record scans with the radar's current settings, without imaging, until a limit or Ctrl-C.

    Example: tagid radar record --seconds 3600 --save-dir /data/today
    """
    from tagid.metadata import ObjectInfo
    from tagid.operate.words import notes
    from tagid.operate.workplace import Workplace
    from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
    from tagid.recording.plan import RecordingPlan, capture_path

    folder = None if save_dir is None else str(save_dir)
    config = load_config(
        {
            "radar.url": radar,
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_height_m": antenna_height,
            "motion.antenna_separation_m": antenna_separation,
            "radar.cable_delay_ps": cable_delay,
            "storage.folder": folder,
        }
    )
    radar_url(config)
    if scans is not None and scans < 1:
        raise UsageError(f"--scans is {scans}", "Give 1 or more.")
    _check_seconds(seconds)
    path = out or capture_path(Workplace(config).folder())
    if not path.name.endswith(CAPTURE_SUFFIX):
        raise UsageError(f"--out is {path}", "Give a name that ends in .tagid.h5.")
    plan = RecordingPlan(
        None,
        config["motion.axis_distance_m"],
        config["motion.antenna_height_m"],
        config["motion.antenna_separation_m"],
        config["radar.cable_delay_ps"],
        motion=config["motion.url"].public,
        object=ObjectInfo(note=note or None),
        resume_s=config["radar.resume_s"],
        renumber=out is None,
    )
    limits = RecordingLimits(scans, seconds, interval_us)
    with (
        terminal.progress("record", seconds or scans) as advance,
        interrupts.asked_to_stop() as asked_to_stop,
    ):

        def progress(state: RecordingState) -> None:
            done = state.seconds if seconds else float(state.scans)
            advance(done, f"{state.scans} scans, {state.seconds:.0f} s, {state.lost} lost, "
                    f"{state.journal_bytes / 1e6:.1f} MB")  # fmt: skip

        watch = RecordingWatch(progress, asked_to_stop)
        written = record_long(open_configured(config), plan, limits, path, watch)
    lost = written.radar.scans_lost or 0
    names = [str(path) for path in written.paths]
    text = "\n".join([f"{counted(written.views, 'scan')} of {written.bins} samples, {lost} lost", *names])
    data: dict[str, Any] = {
        "path": names[0],
        "paths": names,
        "views": written.views,
        "bins": written.bins,
        "scans_lost": lost,
        "scans_dropped": written.radar.scans_dropped,
        "gaps": [gap.to_json() for gap in written.radar.gaps],
        "statistics": written.radar.statistics,
        "complete": written.complete,
        "stopped_by_user": asked_to_stop(),
    }
    code = EXIT_OK if written.complete else EXIT_INTERRUPTED
    return Result("radar record", data, text, exit_code=code, messages=tuple(notes(written.radar)))


def _check_seconds(seconds: float | None) -> None:
    if seconds is not None and not 0 < seconds < 1e8:
        raise UsageError(f"--seconds is {seconds}", "Give a positive number of seconds.")


@command("radar reboot")
def reboot(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    wait: Annotated[
        float, typer.Option(parser=SECONDS, help="Longest time to wait for a response, s.")
    ] = 20.0,
) -> Result:
    """Restart the radar and wait until it responds (7 s on Ethernet, 11 s otherwise).

    Example: tagid radar reboot --radar udp://192.168.1.100
    """

    if not 1 <= wait <= 600:
        raise UsageError(f"--wait is {wait}", "Give 1 to 600 seconds.")
    config = load_config({"radar.url": radar})
    started = time.monotonic()
    with open_configured(config) as device, terminal.progress("reboot", wait):
        taken = device.reboot(wait)
    took = time.monotonic() - started
    url = radar_url(config)
    data = {"url": url, "seconds": round(took, 3), "config": asdict(taken)}
    return Result("radar reboot", data, f"{url} responds again after {took:.1f} s")


_REFRESHES = 24
"""Target frame rate per second; drawing takes time, and 10 are required over a slow connection."""
_TEMPERATURE_EVERY_S = 2.0


@command("radar monitor")
def monitor(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    changing: Annotated[
        bool, typer.Option("--changing", help="Subtract the running mean, to show only what changes.")
    ] = False,
    seconds: Seconds = None,
    interval_us: Interval = 0,
    cable_delay: options.CableDelay = None,
) -> Result:
    """Show range over time, strongest return, clipping, loss and temperature, at the radar's settings.

    Example: tagid radar monitor --radar udp://192.168.1.100
    """
    _check_seconds(seconds)
    config = load_config({"radar.url": radar, "radar.cable_delay_ps": cable_delay})
    radar_url(config)
    return _watch(terminal, config, changing, seconds, interval_us)


def _watch(
    terminal: Terminal, config: Config, changing: bool, seconds: float | None, interval_us: int
) -> Result:
    from rich.console import Console
    from rich.live import Live

    from tagid.cli.imaging import Screen
    from tagid.recording.monitoring import Monitor
    from tagid.report.waterfall import draw

    console = Console(stderr=True, highlight=False)
    with open_configured(config) as device:
        view = Monitor(device.config, config["radar.cable_delay_ps"], changing)
        view.temperature_c = device.status().temperature_c
        screen = Screen(console, f"tagid radar monitor {radar_url(config)}", view.snapshot, draw)
        try:
            if terminal.quiet or not console.is_terminal:
                _receive(device, view, seconds, interval_us)
            else:
                with Live(
                    console=console, screen=True, refresh_per_second=_REFRESHES,
                    get_renderable=screen.counted_frame, redirect_stdout=False, redirect_stderr=False,
                ):  # fmt: skip
                    _receive(device, view, seconds, interval_us)
        except KeyboardInterrupt:
            pass  # the usual end
    last = view.snapshot()
    data: dict[str, Any] = {
        "seconds": last.seconds,
        "scans": last.scans,
        "scan_rate_hz": last.scan_rate_hz,
        "snr_db": last.snr_db,
        "peak_m": last.peak_m,
        "clipped_fraction": last.clipped_fraction,
        "lost": last.lost,
        "lost_fraction": last.lost_fraction,
        "temperature_c": last.temperature_c,
        **screen.facts(),
    }
    text = f"{last.scans} scans in {last.seconds:.1f} s, {last.lost} lost, {last.strongest}"
    return Result("radar monitor", data, text)


def _receive(device: P440, view: Monitor, seconds: float | None, interval_us: int) -> None:
    from tagid.metadata import ScanGap
    from tagid.radar.resume import steady_scans

    def note(gap: ScanGap) -> None:
        view.note = f"the radar was disconnected for {gap.seconds:.1f} s: {gap.reason}"

    began = time.monotonic()
    ask_at = began + _TEMPERATURE_EVERY_S
    for scan in steady_scans(device, interval_us=interval_us, on_gap=note):
        view.add(scan, device.statistics)
        now = time.monotonic()
        if now >= ask_at:
            ask_at = now + _TEMPERATURE_EVERY_S
            device.ask_status()
        if device.latest_status is not None:
            view.temperature_c = device.latest_status.temperature_c
        if seconds is not None and now - began >= seconds:
            return
