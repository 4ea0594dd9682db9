"""`tagid motion calibrate`: a robot's wheel base, or a table's direction, measured with the radar."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import options
from tagid.cli.common.consent import Yes, agree_to
from tagid.cli.common.frame import Terminal, command
from tagid.config import Config, load_config
from tagid.errors import DataError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion calibrate")
    def calibrate(
        terminal: Terminal,
        capture: Annotated[
            Path | None, typer.Argument(help="An earlier scan with this device; default: record one.")
        ] = None,
        radar: options.RadarUrl = None,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        turns: Annotated[float, typer.Option("--turns", help="Revolutions to record, 1.5 to 10.")] = 2.3,
        save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the capture.")] = None,
        direction: Annotated[
            bool, typer.Option("--direction", help="Determine a table's direction instead; needs --layout.")
        ] = False,
        layout: Annotated[
            str | None,
            typer.Option("--layout", help="Enrolled layout on the table; not its own mirror image."),
        ] = None,
        yes: Yes = False,
    ) -> Result:
        """Compare the rotation of a robot or table with the radar scans, and store the correction.

        For a robot this determines the effective wheel base; use an object with strong, asymmetric echoes.
        With --direction it determines whether a table rotates in the commanded direction; use an object with
        an enrolled layout that is not its own mirror image.

        Example: tagid motion calibrate --motion roomba+serial:///dev/ttyUSB1 --axis-distance 1.0
        """
        from rich.text import Text

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
        robot, found = wheel_base_from(resolved)
        path = remember(robot, found)
        data = {"robot": robot, "wheel_base_mm": found.wheel_base_mm, "sigma": found.sigma, "path": str(path)}
        text = f"{robot}: effective wheel base {found.wheel_base_mm:.2f} mm, +- {found.sigma:.2%}"
        return Result("motion calibrate", data, Text(text))


def _direction(capture: Capture, name: str) -> Result:
    """Whether the capture's table rotated in the stated direction; stored for commanded tables."""
    from rich.text import Text

    from tagid.cli.motion.direction import turned_the_other_way
    from tagid.metadata import ResolvedMotion
    from tagid.motion.calibration import remember_reversed
    from tagid.operate.workplace import open_registry
    from tagid.pipeline.prepared import prepare

    layouts = {layout.name: layout for layout in open_registry().layouts()}
    if name not in layouts:
        raise UsageError(f"there is no layout named {name!r}", f"Enrolled: {', '.join(sorted(layouts))}.")
    capture = prepare(capture)
    resolved = capture.motion.resolved or ResolvedMotion()
    told = "clockwise" if resolved.direction == -1 else "counter-clockwise"
    other = turned_the_other_way(capture, layouts[name])
    device, path = resolved.table, None
    is_reversed = other != bool(resolved.reversed)
    if device is not None:
        path = remember_reversed(device, is_reversed)
        lesson = f"stored as reversed={int(is_reversed)} in {path}"
    else:
        clockwise = (told == "clockwise") != other
        lesson = f"its --motion URL needs direction={'cw' if clockwise else 'ccw'}"
    measured = "opposite to" if other else "in"
    text = f"{device or 'the table'} was stated to rotate {told} and rotated {measured} that direction; "
    data = {"device": device, "told": told, "other_way": other, "reversed": is_reversed}
    return Result(
        "motion calibrate", {**data, "path": None if path is None else str(path)}, Text(text + lesson)
    )


def _record(terminal: Terminal, config: Config, turns: float) -> Capture:
    from tagid.cli.motion.device import driven
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
