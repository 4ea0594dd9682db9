"""`tagid radar calibrate`: the delay of cables and antennas, and the empty scene."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.consent import agree_to_replace, can_ask, read_line
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES, NANOSECONDS
from tagid.cli.radar import open_configured
from tagid.config import Config, data_folder, load_config, radar_url
from tagid.constants import BACKGROUND_FILE, SPEED_OF_LIGHT
from tagid.errors import DataError, DeviceError, StorageError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.radar.p440 import P440
    from tagid.recording.calibration import DelayEstimate

_SAME_PATH_M = 1.0
"""Largest change of the two-way path through cables and antennas that is stored without a question, m."""


@dataclass(frozen=True)
class _Asked:
    distance: Annotated[
        float | None,
        typer.Option(parser=METRES, help="Measured distance from the antennas to the target, metres."),
    ] = None
    tape_error: Annotated[
        float, typer.Option(parser=METRES, min=0, max=10, help="Standard deviation of this distance, metres.")
    ] = 0.005
    step: Annotated[
        str | None, typer.Option(help="empty, target, or both with a pause to place the target.")
    ] = None
    scans: Annotated[int, typer.Option(min=-2147483648, max=2147483648, help="Scans per step.")] = 200
    longest_delay: Annotated[
        float, typer.Option(parser=NANOSECONDS, help="Upper limit of the delay search, ns.")
    ] = 25.0
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Measure, but store nothing.")] = False
    yes: Annotated[
        bool,
        typer.Option("--yes", "-y", help="Replace a delay that differs by a metre without confirmation."),
    ] = False


@command("radar calibrate")
def calibrate(
    terminal: Terminal,
    asked: _Asked,
    radar: options.RadarUrl = None,
    axis_distance: options.AxisDistance = None,
) -> Result:
    """Measure the cable and antenna delay with a target at a known distance; store the empty scene.

    First the empty scene is recorded, then the target; both results are stored in the configuration.

    Example: tagid radar calibrate --distance 2.00
    """
    from tagid.recording.calibration import take_scans

    config = load_config({"radar.url": radar, "motion.axis_distance_m": axis_distance})
    radar_url(config)
    chosen = _steps(asked.step, asked.distance)
    if not 0 < asked.longest_delay <= 200:
        raise UsageError(f"--longest-delay is {asked.longest_delay} ns", "Give up to 200 ns.")

    def take(what: str) -> Capture:
        with terminal.progress(what, asked.scans) as advance:
            return take_scans(device, asked.scans, lambda done, _: advance(done, f"{done} scans"))

    with open_configured(config) as device:
        before = device.config
        try:
            _set_window(device, config, asked)
            if chosen == "both":
                _ask("Remove the target from the beam")
            empty = None if chosen == "target" else take("empty scene")
            if chosen == "both":
                _ask(f"Put the target at {asked.distance:g} m from the antennas")
            target = None if chosen == "empty" else take("target")
        finally:
            # The radar's settings, unless it is disconnected.
            with suppress(DeviceError):
                device.set_config(replace(before, persist=0))
    return _keep(config, asked, empty, target)


def _set_window(device: P440, config: Config, asked: _Asked) -> None:
    """One window for both steps, which also covers the window of a scan, with the settings of a scan."""
    from tagid.recording.calibration import calibration_window

    distances = [] if asked.distance is None else [asked.distance]
    axis, reach = config["motion.axis_distance_m"], config["imaging.extent_m"] + 0.35
    if axis is not None:
        distances += [max(axis - reach, 0.0), axis + reach]
    if not distances:
        return  # the window of a scan is unknown: keep the radar's window
    base = device.config.configured(config)
    device.set_config(calibration_window(distances, asked.longest_delay * 1e3, base))


def _steps(step: str | None, distance: float | None) -> str:
    if step is None:
        asks = can_ask() and sys.stderr.isatty()
        step = "empty" if distance is None else "both" if asks else "target"
        if distance is None and asks:
            raise UsageError(
                "the target's distance is missing",
                "Give --distance METRES, or --step empty to store only the empty scene.",
            )
    if step not in ("empty", "target", "both"):
        raise UsageError(f"--step is {step!r}", "Give empty, target or both.")
    if step != "empty" and distance is None:
        raise UsageError(f"--step {step} needs the target's distance", "Give --distance METRES.")
    if distance is not None and not 0.1 <= distance <= 100:
        raise UsageError(f"--distance is {distance} m", "Give 0.1 to 100 m.")
    return step


def _ask(what: str) -> None:
    typer.echo(f"{what}, then press Enter.", err=True)
    try:
        read_line()
    except EOFError:
        raise UsageError(
            "no confirmation was received", "Without a terminal, use --step empty and then --step target."
        ) from None


def _check_change(previous_ps: float | None, delay_ps: float, distance_m: float) -> None:
    """Ask before a delay is replaced by one that only other cables, or another distance, could explain.

    Raises StorageError without a terminal, CaptureInterrupted if the user declines.
    """
    if previous_ps is None:
        return
    path_m = (delay_ps - previous_ps) * 1e-12 * SPEED_OF_LIGHT
    if abs(path_m) <= _SAME_PATH_M:
        return
    agree_to_replace(
        f"the measured delay of {delay_ps:.0f} ps is {abs(path_m):.2f} m of path "
        f"{'more' if path_m > 0 else 'less'} than the stored {previous_ps:.0f} ps, as if the target were at "
        f"{distance_m + path_m / 2:.2f} m, not {distance_m:.2f} m",
        "Check --distance and the cables; if both are right, repeat it with --yes.",
    )


def _keep(config: Config, asked: _Asked, empty: Capture | None, target: Capture | None) -> Result:
    from tagid.config import change_settings
    from tagid.files import make_folder
    from tagid.recording.calibration import estimate_delay, make_reference
    from tagid.report.radar import calibration_table
    from tagid.storage.hdf5 import write_capture

    reference = None if empty is None else make_reference(empty)
    estimate: DelayEstimate | None = None
    notes: list[str] = []
    if target is not None and asked.distance is not None:
        background, note = _background(config, reference, target)
        notes += [note] if note else []
        estimate = estimate_delay(
            target, asked.distance, asked.tape_error, background, asked.longest_delay * 1e3
        )
    before = config.values["radar.cable_delay_ps"]
    previous_ps = None if before.source == "default" else float(before.value)
    if estimate is not None and asked.distance is not None and not (asked.dry_run or asked.yes):
        _check_change(previous_ps, estimate.delay_ps, asked.distance)
    changes: dict[str, Any] = {}
    if estimate is not None:
        changes["radar.cable_delay_ps"] = round(estimate.delay_ps, 1)
        changes["radar.cable_delay_sigma_ps"] = round(estimate.sigma_ps, 1)
    path: Path | None = None
    if reference is not None and not asked.dry_run:
        path = data_folder() / BACKGROUND_FILE
        make_folder(path.parent)
        write_capture(path, reference)
        changes["radar.background"] = str(path)
    stored = None if asked.dry_run or not changes else change_settings(changes)
    facts = None if reference is None else reference.radar.reference
    data = {
        "estimate": None if estimate is None else asdict(estimate),
        "previous_delay_ps": previous_ps,
        "distance_m": asked.distance,
        "reference": None if facts is None else facts.to_json(),
        "background": None if path is None else str(path),
        "config": None if stored is None else str(stored),
        "changes": changes,
    }
    table = calibration_table(estimate, facts, None if stored is None else str(stored), previous_ps)
    return Result("radar calibrate", data, table, messages=tuple(notes))


def _background(config: Config, fresh: Capture | None, target: Capture) -> tuple[Any, str]:
    """(mean empty scene on the target's grid or None, remark)."""
    from tagid.recording.calibration import reference_on
    from tagid.storage.importers import read_any

    if fresh is not None:
        return reference_on(fresh, target), ""
    alone = "the empty scene was not subtracted: leakage or a wall may have been mistaken for the target"
    if not config["radar.background"]:
        return None, f"{alone}; run --step empty first"
    try:
        return reference_on(read_any(Path(config["radar.background"])), target), ""
    except (DataError, StorageError) as error:
        return None, f"{alone} ({error.message})"
