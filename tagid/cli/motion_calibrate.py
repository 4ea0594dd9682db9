"""`tagid motion calibrate`: the effective wheel base of a robot, from how the radar sees it turn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.consent import Yes, agree_to
from tagid.cli.frame import Terminal, command
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
            Path | None, typer.Argument(help="A scan with this robot; without it one is recorded.")
        ] = None,
        radar: options.RadarUrl = None,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        turns: Annotated[float, typer.Option("--turns", help="Turns to record, 1.5 to 10.")] = 2.3,
        save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the capture.")] = None,
        yes: Yes = False,
    ) -> Result:
        """Find the wheel base that makes the robot's turns those that the radar sees, and remember it.

        Put something with strong, unsymmetric echoes on the robot.

        Example: tagid motion calibrate --motion roomba+serial:///dev/ttyUSB1 --axis-distance 1.0
        """
        from rich.text import Text

        from tagid.motion.calibration import remember, wheel_base_from
        from tagid.storage.importers import read_any

        if not 1.5 <= turns <= 10:
            raise UsageError(f"--turns is {turns}", "Give 1.5 to 10.")
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
        resolved = recorded.motion.get("resolved")
        if not isinstance(resolved, dict) or resolved.get("kind") != "roomba":
            raise DataError("this scan was not turned by a robot", "Scan with --motion roomba+... first.")
        robot, found = wheel_base_from(resolved)
        path = remember(robot, found)
        data = {"robot": robot, "wheel_base_mm": found.wheel_base_mm, "sigma": found.sigma, "path": str(path)}
        text = f"{robot}: effective wheel base {found.wheel_base_mm:.2f} mm, +- {found.sigma:.2%}"
        return Result("motion calibrate", data, Text(text))


def _record(terminal: Terminal, config: Config, turns: float) -> Capture:
    from tagid.cli.motion_device import driven
    from tagid.cli.radar_device import open_configured
    from tagid.cli.scan import plan_of
    from tagid.motion.resolve import with_angles
    from tagid.recorder import Watch, capture_path, record

    device, _ = driven(config["motion.url"])
    device.turns = turns
    folder = Path(config["storage.folder"] or ".")
    folder.mkdir(parents=True, exist_ok=True)
    limits: tuple[int | None, float] = (None, 20 + 1.5 * device.needed_seconds())
    about: dict[str, Any] = {"note": "calibration"}
    plan = replace(plan_of(config, str(config["radar.url"]), limits, about), renumber=True)
    with terminal.progress("record", device.needed_seconds()) as advance:
        watch = Watch(lambda count, seconds: advance(seconds, f"{count} scans"), with_angles)
        return record(open_configured(config), device, plan, capture_path(folder), watch)
