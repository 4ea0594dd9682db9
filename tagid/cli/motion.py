"""`tagid motion`: find, query, rotate, stop and calibrate robots and turntables."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from tagid.cli import options
from tagid.cli.consent import Yes, agree, agree_to
from tagid.cli.frame import Terminal, command
from tagid.cli.options import SECONDS
from tagid.config import Config, load_config
from tagid.counting import meant
from tagid.errors import EXIT_DEVICE, EXIT_OK, DataError, TagidError, UsageError
from tagid.result import Problem, Result
from tagid.secret import MotionUrl

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.motion.driven import DrivenMotion
    from tagid.report.table import Table
    from tagid.result import Drawn
    from tagid.tags.layouts.layout import Layout

Url = Annotated[
    MotionUrl | None, typer.Argument(help="Another way to give --motion.", parser=MotionUrl, metavar="[URL]")
]


def _one_url(url: MotionUrl | None, motion: MotionUrl | None) -> MotionUrl | None:
    """The device that --motion or, until 0.3, an argument names. Raises UsageError if both do."""
    if url is not None and motion is not None:
        raise UsageError("the device is given twice", "Give --motion alone.")
    return motion if url is None else url


def driven(url: MotionUrl | None, stopping: bool = False) -> DrivenMotion:
    """The device of a URL or of the configuration. Raises UsageError if it is not a commanded device.

    With `stopping` it is only to be stopped, which no file of the user may prevent.
    """
    from tagid.motion.driven import DrivenMotion
    from tagid.motion.urls import EXAMPLES, open_motion

    if url is None or not stopping:
        url = load_config({"motion.url": url}, tolerant=stopping)["motion.url"]
    device = open_motion(url, stopping)
    if not isinstance(device, DrivenMotion):
        raise UsageError(
            f"{url} is not a commanded device",
            f"Give one of {', '.join(name for name in EXAMPLES if '+' in name)}.",
        )
    return device


def facts_table(facts: dict[str, Any]) -> Table:
    from tagid.report.table import Table

    table = Table()
    for key, value in facts.items():
        shown = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else value
        shown = f"{shown:.4g}" if isinstance(shown, float) else str(shown)
        table.add_row(key.replace("_", " "), shown)
    return table


@command("motion find")
def find(
    terminal: Terminal,
    seconds: Annotated[float, typer.Option(parser=SECONDS, help="Listening time, s.")] = 4.0,
    bluetooth: Annotated[bool, typer.Option("--ble/--no-ble", help="Scan for Bluetooth devices.")] = True,
    hci: Annotated[str | None, typer.Option(help="Another Bluetooth controller.")] = None,
) -> Result:
    """Find robots and tables, without sending anything to them.

    Example: tagid motion find
    """
    from tagid.cli.frame import to_copy
    from tagid.motion.discovery import bluetooth_devices, serial_devices
    from tagid.report.table import Table

    if not 0.1 <= seconds <= 60:
        raise UsageError(f"--seconds is {seconds}", "Give 0.1 to 60.")
    devices = serial_devices()
    errors: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    if bluetooth:
        try:
            devices += bluetooth_devices(seconds, hci)
        except TagidError as error:
            if devices:
                # Devices were found, so the command succeeded; that Bluetooth was not searched is a note.
                notes = (f"Bluetooth was not searched: {error.message}. {error.remedy}".strip(),)
            else:
                errors = (Problem.of(error),)
    if not devices and not errors:
        message = "no robot or table was found"
        remedy = (
            "Connect its cable, or power the bridge; a free-running table does not need to be found: "
            "use --motion free."
        )
        errors = (Problem("device", message, remedy),)
    table = Table("where", "what", "signal")
    for device in devices:
        table.add_row(
            device.where, device.what, "" if device.signal_dbm is None else f"{device.signal_dbm} dBm"
        )
    urls = to_copy([device.url for device in devices if device.url], "tagid motion info --motion {}")
    data = {"devices": [asdict(device) for device in devices]}
    human: Drawn | None = [table, urls] if devices else None
    code = EXIT_OK if devices else EXIT_DEVICE
    return Result("motion find", data, human, exit_code=code, messages=notes, errors=errors)


@command("motion info")
def info(terminal: Terminal, url: Url = None, motion: options.MotionUrl = None) -> Result:
    """Show the state of a robot or table; nothing moves.

    Example: tagid motion info --motion roomba+serial:///dev/ttyUSB1
    """
    device = driven(_one_url(url, motion))
    facts = device.describe()
    return Result("motion info", facts, facts_table(facts))


_LOOK_S = 0.05


@command("motion spin")
def spin(
    terminal: Terminal,
    url: Url = None,
    motion: options.MotionUrl = None,
    turns: Annotated[float, typer.Option(help="Number of revolutions, 0.01 to 20.")] = 1.0,
    yes: Yes = False,
) -> Result:
    """Rotate by a number of revolutions and stop.

    Example: tagid motion spin --motion roomba+serial:///dev/ttyUSB1 --turns 0.5
    """
    if not 0.01 <= turns <= 20:
        raise UsageError(f"--turns is {turns}", "Give 0.01 to 20.")
    device = driven(_one_url(url, motion))
    device.turns = turns
    way = "clockwise" if device.direction < 0 else "counter-clockwise"
    agree(
        f"{device.name} will rotate {way} by {turns:g} revolutions, {device.nominal_s:.0f} s each",
        yes,
        device.warning,
    )
    begin = time.monotonic()
    with terminal.progress("turn", turns) as advance:
        try:
            device.start()
            while not device.finished([], []):
                device.check()
                done = abs(device.turned_rad) / (2 * math.pi)
                advance(done, f"{done * 360:.0f} degrees")
                time.sleep(_LOOK_S)
        finally:
            device.stop()
    track = device.track()
    facts = {
        "turned_deg": math.degrees(device.turned_rad),
        "sigma_deg": math.degrees(
            math.hypot(float(track.sigma_rad[-1]), device.scale_sigma * device.turned_rad)
        ),
        "seconds": time.monotonic() - begin,
        "readings": len(track),
        **track.info,
    }
    return Result("motion spin", facts, facts_table(facts))


@command("motion stop")
def stop(terminal: Terminal, url: Url = None, motion: options.MotionUrl = None) -> Result:
    """Stop a robot or table, even while another process drives it; a robot is left in Passive mode.

    Example: tagid motion stop --motion roomba+ble://tagid-bridge
    """

    device = driven(_one_url(url, motion), stopping=True)
    device.halt_now()
    return Result("motion stop", {"stopped": True}, f"{device.name} has stopped")


@command("motion calibrate")
def calibrate(
    terminal: Terminal,
    capture: Annotated[
        Path | None, typer.Argument(help="An earlier scan with this device; default: record one.")
    ] = None,
    radar: options.RadarUrl = None,
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    turns: Annotated[float, typer.Option(help="Revolutions to record, 1.5 to 10.")] = 2.3,
    save_dir: Annotated[Path | None, typer.Option(help="Folder for the capture.")] = None,
    direction: Annotated[
        bool, typer.Option("--direction", help="Determine a table's direction instead; needs --layout.")
    ] = False,
    layout: Annotated[
        str | None, typer.Option(help="Enrolled layout on the table; not its own mirror image.")
    ] = None,
    yes: Yes = False,
) -> Result:
    """Compare the rotation of a robot or table with the radar scans, and store the correction.

    For a robot this determines the effective wheel base; use an object with strong, asymmetric echoes.
    With --direction it determines whether a table rotates in the commanded direction; use an object with
    an enrolled layout that is not its own mirror image.

    Example: tagid motion calibrate --motion roomba+serial:///dev/ttyUSB1 --axis-distance 1.0
    """
    from tagid.motion.calibration import remember, wheel_base_from
    from tagid.storage.importers import read_any

    if not 1.5 <= turns <= 10:
        raise UsageError(f"--turns is {turns}", "Give 1.5 to 10.")
    if direction != (layout is not None):
        raise UsageError("--direction and --layout must be given together", "Give both or neither.")
    if capture is not None:
        recorded = read_any(capture)
    else:
        config = load_config(
            {
                "radar.url": radar,
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "storage.folder": None if save_dir is None else str(save_dir),
            }
        )
        agree_to(config["motion.url"], yes)
        recorded = _record(terminal, config, turns)
    if layout is not None:
        return _direction(recorded, layout)
    resolved = recorded.motion.resolved
    if resolved is None or resolved.kind != "roomba":
        raise DataError("this scan was not recorded with a robot", "Scan with --motion roomba+... first.")
    robot, base = wheel_base_from(resolved)
    path = remember(robot, base)
    data = {"robot": robot, "wheel_base_mm": base.wheel_base_mm, "sigma": base.sigma, "path": str(path)}
    text = f"{robot}: effective wheel base {base.wheel_base_mm:.2f} mm, +- {base.sigma:.2%}"
    return Result("motion calibrate", data, text)


def _direction(capture: Capture, name: str) -> Result:
    """Whether the capture's table rotated in the stated direction; stored for commanded tables."""
    from tagid.metadata import ResolvedMotion
    from tagid.motion.calibration import remember_reversed
    from tagid.operate.workplace import open_registry
    from tagid.pipeline.prepared import prepare

    layouts = {layout.name: layout for layout in open_registry().layouts()}
    if name not in layouts:
        raise UsageError(
            f"no layout is named {name[:80]!r}",
            f"{meant(name, layouts)}Enrolled: {', '.join(sorted(layouts))}.",
        )
    capture = prepare(capture)
    resolved = capture.motion.resolved or ResolvedMotion()
    way = "clockwise" if resolved.direction == -1 else "counter-clockwise"
    other = _turned_the_other_way(capture, layouts[name])
    device, path = resolved.table, None
    is_reversed = other != bool(resolved.reversed)
    if device is not None:
        path = remember_reversed(device, is_reversed)
        lesson = f"stored as reversed={int(is_reversed)} in {path}"
    else:
        clockwise = (way == "clockwise") != other
        lesson = f"its --motion URL needs direction={'cw' if clockwise else 'ccw'}"
    measured = "opposite to" if other else "in"
    text = f"{device or 'the table'} was stated to rotate {way} and rotated {measured} that direction; "
    data = {"device": device, "told": way, "other_way": other, "reversed": is_reversed}
    return Result("motion calibrate", {**data, "path": None if path is None else str(path)}, text + lesson)


def _record(terminal: Terminal, config: Config, turns: float) -> Capture:
    from tagid.metadata import ObjectInfo
    from tagid.operate.turn import record_turn
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.resolve import with_angles
    from tagid.recording.recorder import Watch

    device = driven(config["motion.url"])
    device.turns = turns
    place = Workplace(config)
    longest_s = 20 + 1.5 * device.needed_seconds()
    plan = place.plan(max_seconds=longest_s, about=ObjectInfo(note="calibration"))
    with terminal.progress("record", device.needed_seconds()) as advance:
        watch = Watch(lambda count, seconds: advance(seconds, f"{count} scans"), with_angles)
        return record_turn(place, plan, device, watch).capture


_LEAST_DIFFERENCE_M: Final = 5e-3
"""Smallest resolvable RMS distance between a layout and its mirror image: a few position errors."""


def _turned_the_other_way(capture: Capture, layout: Layout) -> bool:
    """Whether the object rotated opposite to its prepared capture's angles: its mirror image is read.

    Raises UsageError, DataError.
    """
    from tagid.pipeline.identify import identify
    from tagid.pipeline.settings import ImagingSettings
    from tagid.tags.layouts.codebook import best_pairing

    image = layout.mirrored()
    if layout.size > 7 or best_pairing(image.positions, layout.positions, 0.2).rms_m < _LEAST_DIFFERENCE_M:
        raise UsageError(
            f"layout {layout.name} is its own mirror image (or has more than 7 reflectors)",
            "Use an object whose reflectors do not form a symmetric pattern.",
        )
    mirror = replace(image, name=f"{layout.name}-mirrored")
    answer = identify(capture, [layout, mirror], ImagingSettings(direction_known=True))
    read = answer.reading.layout if answer.status == "identified" and answer.reading is not None else None
    if read not in (layout.name, mirror.name):
        raise DataError(
            f"neither layout {layout.name} nor its mirror image was read ({answer.status})",
            "Check --layout and the axis distance, and record a full revolution with a clear view of it.",
        )
    return read == mirror.name
