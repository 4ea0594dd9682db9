"""`tagid import`, `export`, `recover` and `join`: convert, rebuild and join captures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_new
from tagid.config import load_config
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import StorageError, UsageError
from tagid.result import Result

_Out = Annotated[Path | None, typer.Option("--out", "-o", help="File to write.")]
_Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")]


@command("import")
def import_(
    terminal: Terminal,
    file: options.CaptureFile,
    out: _Out = None,
    axis_distance: options.AxisDistance = None,
    antenna_height: options.AntennaHeight = None,
    antenna_separation: options.AntennaSeparation = None,
    cable_delay: options.CableDelay = None,
    node: options.Node = None,
    force: _Force = False,
) -> Result:
    """Convert another tool's recording to a capture file.

    Read are P440 recordings, MRM-RET logs, MATLAB structs of the vendor's log reader, journals, and NPZ
    files with the keys samples (views, bins), range_start_m, range_step_m and one of angles_rad (with
    axis_distance_m), timestamps_s or antenna_positions_m (views, 3):
    numpy.savez("mine.npz", samples=..., range_start_m=..., range_step_m=..., angles_rad=...,
    axis_distance_m=...). Units are m, s and rad.

    Example: tagid import scan08.out --out scan08.tagid.h5
    """
    from tagid.pipeline.prepared import LoadSettings, intake_remarks, load_capture
    from tagid.storage.hdf5 import write_capture

    config = load_config(
        {
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_height_m": antenna_height,
            "motion.antenna_separation_m": antenna_separation,
            "radar.cable_delay_ps": cable_delay,
        }
    )
    target = _target(file, out, CAPTURE_SUFFIX, force)
    if not target.name.endswith(".h5"):
        raise UsageError(
            f"{target} does not end in {CAPTURE_SUFFIX}", "Use `tagid export` for other formats."
        )
    capture = load_capture(file, LoadSettings.of(config, node=node), turn=False)
    write_capture(target, capture)
    line = f"{target}: {counted(capture.views, 'scan')} of {capture.bins} samples"
    data = {
        "path": str(target),
        "views": capture.views,
        "bins": capture.bins,
        "uuid": capture.uuid,
        "complete": capture.complete,
        "node": capture.radar.node_id,
        "bytes_left_over": capture.radar.bytes_left_over or 0,
        "scans_lost": capture.radar.scans_lost or 0,
    }
    return Result("import", data, line, messages=intake_remarks(capture))


@command("export")
def export(
    terminal: Terminal,
    file: options.CaptureFile,
    out: _Out = None,
    node: options.Node = None,
    force: _Force = False,
) -> Result:
    """Write a capture as NPZ, MATLAB (.mat), P440 recording (.out, .prd), MRM-RET log (.csv) or .h5.

    Example: tagid export helmet.tagid.h5 --out helmet.mat
    """
    from tagid.storage.exporters import export as write
    from tagid.storage.importers import read_any, remarks

    target = _target(file, out, ".npz", force)
    capture = read_any(file, node=node)
    write(capture, target)
    data = {"path": str(target), "views": capture.views, "bins": capture.bins}
    return Result("export", data, f"{target} written", messages=remarks(capture))


@command("recover")
def recover(
    terminal: Terminal,
    journal: Annotated[Path, typer.Argument(help="The .tagid.journal file.")],
    out: _Out = None,
    force: _Force = False,
) -> Result:
    """Create a capture file from the journal of an interrupted recording.

    Example: tagid recover scan-20260102-101112.tagid.journal
    """
    from tagid.pipeline.resolve import with_measured_angles
    from tagid.recording.long_recording import part_path
    from tagid.storage.hdf5 import write_capture
    from tagid.storage.journal import being_recorded, open_journal
    from tagid.storage.journal_capture import read_journal_capture, write_captures

    if being_recorded(journal):
        raise StorageError(
            f"{journal} is still being recorded by another process",
            "That process writes the capture file when it ends.",
        )
    # What is no journal is told before anything about the file to write.
    with open_journal(journal):
        pass
    target = _target(journal, out, CAPTURE_SUFFIX, force)
    written = write_captures(journal, lambda part: part_path(target, part))
    if written.has_track and len(written.paths) == 1:
        capture = read_journal_capture(journal)
        if capture.motion.track is not None:
            write_capture(target, with_measured_angles(capture))
    state = "complete" if written.complete else "cut short"
    lines = [
        f"{counted(written.views, 'scan')} recovered, the recording was {state}",
        *map(str, written.paths),
    ]
    dropped = written.bytes_dropped
    messages = (f"{dropped} bytes of the journal were dropped because they contain no complete scan",)
    data = {
        "path": str(written.paths[0]),
        "paths": [str(path) for path in written.paths],
        "views": written.views,
        "complete": written.complete,
        "bytes_dropped": dropped,
    }
    return Result("recover", data, "\n".join(lines), messages=messages if dropped else ())


def _target(source: Path, out: Path | None, suffix: str, force: bool) -> Path:
    if out is None:
        stem = source.name
        for ending in (CAPTURE_SUFFIX, ".tagid.journal", source.suffix):
            if ending and stem.endswith(ending):
                stem = stem.removesuffix(ending)
                break
        out = source.with_name(stem + suffix)
    check_new(out, force, "Choose another name with --out, or add --force.", [source])
    return out


@command("join")
def join(
    terminal: Terminal,
    files: options.Captures,
    out: Annotated[Path, typer.Option("--out", "-o", help="Capture or NPZ file to write.")],
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    antenna_separation: options.AntennaSeparation = None,
    align: Annotated[
        bool, typer.Option("--align", help="Estimate the rotation of each capture relative to the first.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> Result:
    """Join captures of one object from several antenna heights into one capture with antenna positions.

    Every capture must state its own antenna height, and the same object angle for the same pose. The
    angles of a recording begin at its first scan; --align refers them to the first capture's pose.

    Example: tagid join low.tagid.h5 middle.tagid.h5 high.tagid.h5 --out all.tagid.h5
    """
    from tagid.pipeline.join import heights_of
    from tagid.pipeline.join import join as joined_of
    from tagid.pipeline.prepared import LoadSettings, load_capture
    from tagid.storage.exporters import export

    check_new(out, force, inputs=files)
    config = load_config(
        {
            "motion.url": motion,
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_separation_m": antenna_separation,
        }
    )
    loading = LoadSettings.of(config)
    captures = [load_capture(file, loading) for file in files]
    turns: list[float] | None = None
    if align:
        from tagid.pipeline.alignment import aligned

        captures, rotations = aligned(captures)
        turns = [rotation.rotation_deg for rotation in rotations]
    joined = joined_of(captures)
    levels = heights_of(joined)
    positions = joined.aperture().positions
    heights = [float(positions[views, 2].mean()) for views in levels]
    export(joined, out)
    data = {"path": str(out), "views": joined.views, "bins": joined.bins, "heights_m": heights}
    data |= {} if turns is None else {"rotations_deg": turns}
    words = ", ".join(f"{height:.3f}" for height in heights[:8]) + (" ..." if len(heights) > 8 else "")
    line = f"{out}: {joined.views} views from {len(heights)} antenna heights ({words} m)"
    if turns is not None:
        line += f", rotated by {', '.join(f'{turn:+.2f}' for turn in turns[:8])} deg"
    return Result("join", data, line)
