"""`tagid scan --heights`: one recording from each antenna height, joined into one capture.

Every recording is a capture of its own with its own journal; the joined capture is written beside them at the
end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid import interrupts
from tagid.cli.common.frame import Terminal
from tagid.cli.common.prompts import can_ask, confirm
from tagid.cli.common.recording import Limits, capture_folder, plan_of, radar_url
from tagid.config import Config
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import CaptureInterrupted, TagidError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tagid.capture import Capture
    from tagid.metadata import ObjectInfo
    from tagid.pipeline.alignment import Alignment
    from tagid.pipeline.answer import Identification

MAX_HEIGHTS = 100
MAX_HEIGHT_M = 10.0
LEAST_STEP_M = 1e-3
PICTURE_PIXELS = 64
"""Pixels of each level of the volume that is drawn: 8 mm, a tenth of a wavelength, at the default extent."""


def parse_heights(text: str) -> tuple[float, ...]:
    """Antenna heights of --heights in metres, in the order of recording. Raises UsageError.

    >>> parse_heights("0,0.05,0.1")
    (0.0, 0.05, 0.1)
    """
    try:
        heights = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--heights is {text[:80]!r}", "Give metres, such as --heights 0,0.15,0.30."
        ) from None
    if not 2 <= len(heights) <= MAX_HEIGHTS:
        raise UsageError(f"--heights gives {counted(len(heights), 'height')}", f"Give 2 to {MAX_HEIGHTS}.")
    if not all(abs(height) <= MAX_HEIGHT_M for height in heights):
        raise UsageError(
            f"--heights is {text[:80]!r}", f"Give heights from -{MAX_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m."
        )
    ordered = sorted(heights)
    if min(b - a for a, b in itertools.pairwise(ordered)) < LEAST_STEP_M:
        raise UsageError(f"--heights is {text[:80]!r}", "Give heights at least 1 mm apart.")
    return heights


@dataclass(frozen=True)
class Lift:
    """How the antenna gets to a height.

    Attributes:
        place: moves it, m; None: the operator does, and confirms it on the terminal.
        asks: whether the operator is asked; with --yes the antenna is taken to be there.
        emulated: the radar is an emulator of this program, whose URL states the height.
    """

    place: Callable[[float], None] | None = None
    asks: bool = False
    emulated: bool = False

    @classmethod
    def of(cls, config: Config, yes: bool) -> Lift:
        """The lift of a configured radar.

        Raises:
            UsageError: the operator would have to be asked and there is no terminal.
            ConfigError: no radar is configured.
        """
        if radar_url(config).startswith("emulator://"):
            return cls(emulated=True)
        if not yes and not can_ask():
            raise UsageError(
                "--heights asks for the antenna to be moved, and there is no terminal to ask on",
                "Run it in a terminal; add --yes only if the antenna is moved without being asked.",
            )
        return cls(asks=not yes)

    def raise_to(self, height_m: float, which: str, url: str) -> str:
        """Move the antenna, or have it moved; returns the radar's URL. Raises CaptureInterrupted."""
        if self.emulated:
            return f"{url}{'&' if '?' in url else '?'}antenna_height={height_m!r}"
        if self.place is not None:
            self.place(height_m)
        elif self.asks:
            text = f"{which}: move the antenna to {height_m:.3f} m above the object's plane. Is it there?"
            if not confirm(text, default=True):
                raise CaptureInterrupted(f"stopped before {which.lower()}")
        return url


def scan_heights(
    terminal: Terminal,
    config: Config,
    limits: Limits,
    about: ObjectInfo,
    heights: tuple[float, ...],
    lift: Lift,
) -> Result:
    """Record one revolution from each height, join them, draw the volume and name the object.

    Recordings that are complete stay on disk whatever happens later; the error then names them.

    Args:
        terminal, config, limits: of the command.
        about: description of the object, stored in every capture.
        heights: of the antenna above the object's plane, m.
        lift: how the antenna is moved.
    """
    paths: list[Path] = []
    try:
        captures = [
            _record(
                terminal, config, limits, about, height, lift, f"Height {number} of {len(heights)}", paths
            )
            for number, height in enumerate(heights, start=1)
        ]
        return _joined(terminal, config, captures, paths, heights)
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, _kept(paths)) from stop
    except TagidError as error:
        raise type(error)(error.message, f"{error.remedy} {_kept(paths)}".strip()) from error


def _record(
    terminal: Terminal,
    config: Config,
    limits: Limits,
    about: ObjectInfo,
    height_m: float,
    lift: Lift,
    which: str,
    paths: list[Path],
) -> Capture:
    """Record one revolution; its path is appended once the capture is complete."""
    from tagid.motion.urls import open_motion
    from tagid.pipeline.turn import resolve_turn
    from tagid.recording.plan import capture_path
    from tagid.recording.radars import open_radar
    from tagid.recording.recorder import Watch, record

    url = lift.raise_to(height_m, which, radar_url(config))
    plan = replace(plan_of(config, url, limits, about), antenna_height_m=height_m, renumber=True)
    motion = open_motion(config["motion.url"])
    named: list[Path] = []
    with terminal.progress(f"{height_m:.3f} m", motion.needed_seconds()) as advance:
        watch = Watch(
            resolve=resolve_turn,
            named=named.append,
            progress=lambda count, s: advance(s, f"{count} scans, {s:.1f} s"),
        )
        radar = open_radar(url, config["radar.timeout_s"])
        capture = record(radar, motion, plan, capture_path(capture_folder(config)), watch)
    paths.append(named[-1])
    return capture


def _joined(
    terminal: Terminal,
    config: Config,
    captures: list[Capture],
    paths: list[Path],
    heights: tuple[float, ...],
) -> Result:
    """Join the recordings, then read and draw the joined capture."""
    from rich.console import Group
    from rich.text import Text

    from tagid.cli.common import imaging
    from tagid.pipeline.alignment import aligned
    from tagid.pipeline.join import join
    from tagid.pipeline.load import LoadDefault, LoadSettings, load_capture
    from tagid.recording.intake import notes
    from tagid.storage.hdf5 import write_capture

    loading = replace(LoadSettings.of(config, as_recorded=True), antenna_height_m=LoadDefault())
    turns, found = aligned([load_capture(capture, loading) for capture in captures])
    joined = replace(join(turns), object=captures[0].object)
    stem = paths[0].name.removesuffix(CAPTURE_SUFFIX)
    path = paths[0].with_name(f"{stem}-heights{CAPTURE_SUFFIX}")
    png = paths[0].with_name(f"{stem}-heights.png")
    write_capture(path, joined)
    answer = _read(config, joined)
    files: dict[str, str | None] = {"capture": str(path), "png": None}
    drawn: list[RenderableType] = [imaging.describe(answer, "")]
    try:
        _draw(terminal, config, joined, png)
        files["png"] = str(png)
    except TagidError as error:
        drawn.append(Text(f"no picture: {error.message}"))
    rows = [_facts(*each) for each in zip(heights, paths, captures, found, strict=True)]
    for row in rows:
        turned = f"rotated {row['rotation_deg']:+.2f} deg"
        drawn.append(Text(f"{row['height_m']:.3f} m  {row['views']} scans, {turned}  {row['file']}"))
    drawn += [Text(f"{name:<8} {where}") for name, where in files.items() if where]
    items = [{"file": str(path), **answer.to_dict()}]
    kept = imaging.remember(
        "scan", items, {"radar": config["radar.url"], "motion": config["motion.url"].public}
    )
    messages = tuple(dict.fromkeys(note for capture in captures for note in notes(capture.radar)))
    errors = () if answer.error is None else (answer.error,)
    return Result(
        "scan",
        {"items": items, "heights": rows, "files": files, "views": joined.views},
        Group(*drawn),
        "error" if errors else "success",
        imaging.exit_code_of([answer]),
        (*messages, *kept),
        errors,
    )


def _read(config: Config, joined: Capture) -> Identification:
    from tagid.cli.common import imaging
    from tagid.pipeline.identify import identify
    from tagid.pipeline.prepared import PreparedCapture, prepare

    known = imaging.open_registry().contents()
    try:
        settings = imaging.settings_from(config)
        prepared = PreparedCapture(prepare(joined, extent_m=settings.extent_m), settings)
        return identify(prepared, known.layouts, registry_version=known.version, signatures=known.signatures)
    except TagidError as error:
        return imaging.failed(joined.uuid, error)


def _draw(terminal: Terminal, config: Config, joined: Capture, png: Path) -> None:
    """Write the three maximum projections of the backprojected volume."""
    from tagid.pipeline.volume import VolumeSettings, reconstruct_volume
    from tagid.report.volume_picture import draw_projections

    settings = VolumeSettings("bp", config["imaging.extent_m"], PICTURE_PIXELS, held_out=False)
    with terminal.progress("volume", total=1.0) as advance:
        made = reconstruct_volume(joined, settings, lambda done, total, _: advance(done / max(total, 1), ""))
    grid = made.volume.grid
    draw_projections(made.volume.values, grid.square.axis, grid.heights, png, "BP volume")


def _facts(height_m: float, path: Path, capture: Capture, found: Alignment) -> dict[str, Any]:
    return {
        "height_m": height_m,
        "file": str(path),
        "views": capture.views,
        "rotation_deg": found.rotation_deg,
        "likeness": found.likeness,
    }


def _kept(paths: list[Path]) -> str:
    """What is on disk, and how to go on with it; "" if nothing is."""
    if not paths:
        return ""
    names = " ".join(str(path) for path in paths)
    if len(paths) == 1:
        return f"The capture of the first height is stored in {names}."
    return (
        f"The captures of {len(paths)} heights are stored; "
        f"`tagid join --align {names} --out all{CAPTURE_SUFFIX}` joins them."
    )
