"""`tagid join`, and the implementation of `tagid reconstruct --volume`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing, check_new
from tagid.config import Config, load_config
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.imaging.volume import Volume


@command("join")
def join(
    terminal: Terminal,
    files: options.Captures,
    out: Annotated[Path, typer.Option("--out", "-o", help="Capture or NPZ file to write.")],
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    antenna_separation: options.AntennaSeparation = None,
    align: Annotated[
        bool,
        typer.Option("--align", help="Estimate the rotation of each capture relative to the first."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> Result:
    """Join captures of one object from several antenna heights into one capture with antenna positions.

    Every capture must state its own antenna height, and the same object angle for the same pose. The
    angles of a recording begin at its first scan; --align refers them to the first capture's pose.

    Example: tagid join low.tagid.h5 middle.tagid.h5 high.tagid.h5 --out all.tagid.h5
    """
    from rich.text import Text

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
    return Result("join", data, Text(line))


@dataclass(frozen=True)
class Outputs:
    """Files to write; None: not requested."""

    npz: Path | None
    vti: Path | None
    ply: Path | None
    png: Path | None
    webp: Path | None
    surface: Path | None = None

    @property
    def files(self) -> dict[str, Path]:
        """Those requested, by kind."""
        return {kind: path for kind, path in vars(self).items() if path is not None}

    def check(self, source: Path) -> None:
        """Raises as `check_drawing`; `source` is the file that is read."""
        for kind, path in self.files.items():
            option = "--out" if kind == "npz" else f"--{kind}"
            check_drawing(option, path, (".ply" if kind == "surface" else f".{kind}",), [source])


@dataclass(frozen=True)
class Asked:
    """What the command line says of a volume beside the configuration.

    Attributes:
        background: as `--background`.
        heights_m, levels: lowest and highest height, m, and number of levels; None: as `VolumeSettings`.
        held_out: whether to compute how well it predicts held-out views.
    """

    background: str
    heights_m: tuple[float, float] | None
    levels: int | None
    held_out: bool


def make_volume(
    terminal: Terminal, capture: Capture, config: Config, asked: Asked, outputs: Outputs
) -> Result:
    """Reconstruct a volume and write it.

    Args:
        capture: loaded.
        config: with the method, the extent and the pixels.
        asked: what the command line says.
        outputs: files to write, checked.
    """
    from rich.console import Group
    from rich.text import Text

    from tagid.operate.words import held_out_words
    from tagid.pipeline.volume import VolumeSettings, reconstruct_volume

    files = outputs.files
    method = "bp" if config["imaging.method"] == "auto" else config["imaging.method"]
    settings = VolumeSettings(
        method,
        config["imaging.extent_m"],
        config["imaging.pixels"],
        asked.heights_m,
        asked.levels,
        "none" if asked.background == "reference" else asked.background,
        asked.held_out,
    )
    begun = time.monotonic()
    with terminal.progress("volume", total=1.0) as advance:

        def progress(done: float, total: float, remark: str) -> None:
            part = done / max(total, 1)
            remaining_s = (time.monotonic() - begun) * (1 / part - 1) if part > 0 else 0.0
            advance(part, f"{remaining_s:.0f} s left" if part < 1 else "")

        made = reconstruct_volume(capture, settings, progress)
    _write(made.volume, files)
    facts = made.volume.settings
    took = sum(made.seconds.values())
    grid = made.volume.grid
    size = f"{grid.square.pixels} x {grid.square.pixels} x {grid.levels} voxels"
    lines = [
        f"{method} volume of {made.views} views from {made.heights} antenna heights, {size} in {took:.2f} s",
        f"vertical resolution {1e3 * facts['vertical_resolution_m']:.0f} mm",
        *held_out_words(facts),
        *facts.get("warnings", ()),
        *(f"{kind} {path}" for kind, path in files.items()),
    ]
    data: dict[str, Any] = {
        "method": method,
        "settings": facts,
        "files": {kind: str(path) for kind, path in files.items()},
        "seconds": made.seconds,
    }
    return Result("reconstruct", data, Group(*(Text(line) for line in lines)))


def _write(volume: Volume, files: dict[str, Path]) -> None:
    from tagid.report.volume_picture import draw_projections, write_turning
    from tagid.storage.volume import write_surface, write_volume

    axes = volume.grid.square.axis, volume.grid.heights
    for kind, path in files.items():
        if kind == "png":
            draw_projections(volume.values, *axes, path, f"{volume.settings['method'].upper()} volume")
        elif kind == "surface":
            write_surface(path, volume)
        elif kind == "webp":
            write_turning(volume.values, *axes, path)
        else:
            write_volume(path, volume)
