"""`tagid scan --heights`: one recording from each antenna height, joined into one capture.

Every recording is a capture of its own with its own journal; the joined capture is written beside them at the
end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tagid import interrupts
from tagid.cli.consent import can_ask, confirm
from tagid.cli.frame import Terminal
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import CaptureInterrupted, TagidError, UsageError
from tagid.operate.words import notes
from tagid.query import quantity
from tagid.result import Problem, Result

if TYPE_CHECKING:
    from tagid.operate.turn import Recorded
    from tagid.operate.workplace import Workplace
    from tagid.recording.plan import RecordingPlan
    from tagid.result import Drawn

MAX_HEIGHTS = 100
MAX_HEIGHT_M = 10.0
LEAST_STEP_M = 1e-3
PICTURE_PIXELS = 64
"""Pixels of each level of the volume that is drawn: 8 mm, a tenth of a wavelength, at the default extent."""


def parse_heights(text: str) -> tuple[float, ...]:
    """Antenna heights of --heights in metres, in the order of recording. Raises UsageError.

    >>> parse_heights("0,5cm,0.1")
    (0.0, 0.05, 0.1)
    """
    try:
        heights = tuple(quantity(part, "m") for part in text.split(","))
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
        asks: whether the operator, who moves it, is asked; with --yes the antenna is taken to be there.
        emulated: the radar is an emulator of this program, whose URL states the height.
    """

    asks: bool = False
    emulated: bool = False

    @classmethod
    def of(cls, place: Workplace, yes: bool) -> Lift:
        """The lift of a configured radar.

        Raises:
            UsageError: the operator would have to be asked and there is no terminal.
            ConfigError: no radar is configured.
        """
        if place.radar_url().startswith("emulator://"):
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
        if self.asks:
            text = f"{which}: move the antenna to {height_m:.3f} m above the object's plane. Is it there?"
            if not confirm(text, default=True):
                raise CaptureInterrupted(f"stopped before {which.lower()}")
        return url


def scan_heights(
    terminal: Terminal,
    place: Workplace,
    planned: Callable[[], RecordingPlan],
    heights: tuple[float, ...],
    lift: Lift,
) -> Result:
    """Record one revolution from each height, m, join them, draw the volume and name the object.

    Recordings that are complete stay on disk whatever happens later; the error then names them.
    """
    turns: list[Recorded] = []
    with interrupts.naming(lambda: _kept(turns)):
        plan = planned()
        for number, height_m in enumerate(heights, start=1):
            url = lift.raise_to(height_m, f"Height {number} of {len(heights)}", place.radar_url())
            turns.append(_record(terminal, place, replace(plan, antenna_height_m=height_m), url))
        return _joined(terminal, place, turns, heights)


def _record(terminal: Terminal, place: Workplace, plan: RecordingPlan, url: str) -> Recorded:
    from tagid.motion.urls import open_motion
    from tagid.operate.turn import record_turn
    from tagid.recording.recorder import Watch

    motion = open_motion(place.config["motion.url"])
    with terminal.progress(f"{plan.antenna_height_m:.3f} m", motion.needed_seconds()) as advance:
        watch = Watch(progress=lambda count, s: advance(s, f"{count} scans, {s:.1f} s"))
        return record_turn(place, plan, motion, watch, url)


def _joined(
    terminal: Terminal, place: Workplace, turns: list[Recorded], heights: tuple[float, ...]
) -> Result:
    """Join the recordings, then read and draw the joined capture."""
    from tagid.cli import imaging
    from tagid.operate.turn import read
    from tagid.pipeline.alignment import aligned
    from tagid.pipeline.join import join
    from tagid.pipeline.prepared import LoadDefault, load_capture
    from tagid.pipeline.volume import VolumeSettings, reconstruct_volume
    from tagid.report.volume_picture import draw_projections
    from tagid.storage.hdf5 import write_capture

    setup = place.setup(as_recorded=True)
    loading = replace(setup.loading, antenna_height_m=LoadDefault())
    captures = [turn.capture for turn in turns]
    level, alignments = aligned([load_capture(capture, loading) for capture in captures])
    joined = replace(join(level), object=captures[0].object)
    first = turns[0].path
    stem = first.name.removesuffix(CAPTURE_SUFFIX)
    path = first.with_name(f"{stem}-heights{CAPTURE_SUFFIX}")
    png = first.with_name(f"{stem}-heights.png")
    write_capture(path, joined)
    answer = read(replace(setup, loading=loading), joined, path)
    files: dict[str, str | None] = {"capture": str(path), "png": None}
    drawn: list[Drawn] = [imaging.describe(answer, "", terminal.verbose > 0)]
    try:
        settings = VolumeSettings("bp", place.config["imaging.extent_m"], PICTURE_PIXELS, held_out=False)
        with terminal.progress("volume", total=1.0) as advance:
            volume = reconstruct_volume(joined, settings, imaging.share_of(advance)).volume
        draw_projections(volume.values, volume.grid.square.axis, volume.grid.heights, png, "BP volume")
        files["png"] = str(png)
    except TagidError as error:
        drawn.append(f"no picture: {error.message}")
    rows = [
        {
            "height_m": height_m,
            "file": str(turn.path),
            "views": turn.capture.views,
            "rotation_deg": alignment.rotation_deg,
            "likeness": alignment.likeness,
        }
        for height_m, turn, alignment in zip(heights, turns, alignments, strict=True)
    ]
    for row in rows if terminal.verbose else ():
        turned = f"rotated {row['rotation_deg']:+.2f} deg"
        drawn.append(f"{row['height_m']:.3f} m  {row['views']} scans, {turned}  {row['file']}")
    drawn.append(f"  saved {imaging.saved(files)}")
    items = [answer.to_dict()]
    kept = place.remember(
        "scan", items, {"radar": place.radar_url(), "motion": place.config["motion.url"].public}
    )
    losses = (note for capture in captures for note in notes(capture.radar))
    return Result(
        "scan",
        {"items": items, "heights": rows, "files": files, "views": joined.views},
        drawn,
        exit_code=imaging.exit_code_of([answer.identification]),
        messages=(*dict.fromkeys((*losses, *answer.remarks)), *place.without_profile(answer), *kept),
        errors=() if answer.error is None else (Problem.of(answer.error),),
    )


def _kept(turns: list[Recorded]) -> str:
    """What is on disk, and how to go on with it; "" if nothing is."""
    if not turns:
        return ""
    names = " ".join(str(turn.path) for turn in turns)
    if len(turns) == 1:
        return f"The capture of the first height is stored in {names}."
    return (
        f"The captures of {len(turns)} heights are stored; "
        f"`tagid join --align {names} --out all{CAPTURE_SUFFIX}` joins them."
    )
