"""`tagid radar record`: record scans to disk without processing, for any duration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.radar.device import open_configured
from tagid.config import load_config, radar_url
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import EXIT_INTERRUPTED, EXIT_OK, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.recording.long_recording import RecordingState


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar record")
    def record(
        terminal: Terminal,
        radar: options.RadarUrl = None,
        out: Annotated[
            Path | None, typer.Option("--out", "-o", help="Capture to write.", show_default=False)
        ] = None,
        save_dir: Annotated[Path | None, typer.Option("--save-dir", help="Folder for the capture.")] = None,
        scans: Annotated[
            int | None,
            typer.Option("--scans", min=-2147483648, max=2147483648, help="Stop after this number of scans."),
        ] = None,
        seconds: Annotated[
            float | None, typer.Option("--seconds", help="Stop after this time, seconds.")
        ] = None,
        interval_us: Annotated[
            int,
            typer.Option(
                "--interval-us",
                min=0,
                max=4294967295,
                help="Microseconds between scans; 0: as fast as possible.",
            ),
        ] = 0,
        axis_distance: options.AxisDistance = None,
        antenna_height: options.AntennaHeight = None,
        antenna_separation: options.AntennaSeparation = None,
        cable_delay: options.CableDelay = None,
        note: Annotated[str, typer.Option("--note", help="Text stored in the capture, e.g. a place.")] = "",
    ) -> Result:
        """Record scans with the radar's current settings, without imaging, until a limit or Ctrl-C.

        Example: tagid radar record --seconds 3600 --save-dir /data/today
        """
        from rich.text import Text

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
        _check(scans, seconds, interval_us)
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
        names = [str(each) for each in written.paths]
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
        return Result("radar record", data, Text(text), exit_code=code, messages=tuple(notes(written.radar)))


def _check(scans: int | None, seconds: float | None, interval_us: int) -> None:
    if scans is not None and scans < 1:
        raise UsageError(f"--scans is {scans}", "Give 1 or more.")
    if seconds is not None and not 0 < seconds < 1e8:
        raise UsageError(f"--seconds is {seconds}", "Give a positive number of seconds.")
    if not 0 <= interval_us < 2**32:
        raise UsageError(f"--interval-us is {interval_us}", "Give 0 to 4294967295 microseconds.")
