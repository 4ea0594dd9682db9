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
from tagid.query import parse_point
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.imaging.volume import Volume
    from tagid.pipeline.volume import VolumeSettings


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
class VolumeOptions:
    """The volume of `tagid reconstruct --volume` and the files that it is written to."""

    volume: Annotated[
        bool,
        typer.Option("--volume", help="Reconstruct a volume from several antenna heights (see `join`)."),
    ] = False
    heights: Annotated[
        str | None,
        typer.Option(
            "--heights",
            metavar="LOW,HIGH",
            help="Lowest and highest height of the volume, metres.",
            show_default=False,
        ),
    ] = None
    levels: Annotated[
        int | None,
        typer.Option("--levels", help="Number of height levels of the volume.", show_default=False),
    ] = None
    vti: Annotated[
        Path | None, typer.Option("--vti", help="Write the volume as VTK image data.", show_default=False)
    ] = None
    ply: Annotated[
        Path | None,
        typer.Option("--ply", help="Write the bright points of the volume as PLY.", show_default=False),
    ] = None
    surface: Annotated[
        Path | None,
        typer.Option(
            "--surface", help="Write the surface of the volume as PLY triangles.", show_default=False
        ),
    ] = None
    webp: Annotated[
        Path | None,
        typer.Option("--webp", help="Write an animation of the rotating volume.", show_default=False),
    ] = None

    @property
    def given(self) -> bool:
        """Whether a command line says anything of the volume or its files."""
        return bool(self.heights or self.levels or self.vti or self.ply or self.surface or self.webp)

    def files(self, out: Path | None, png: Path | None, source: Path) -> dict[str, Path]:
        """Files to write, by kind. Raises as `check_drawing`; `source` is the file that is read."""
        kinds = {
            "npz": out, "vti": self.vti, "ply": self.ply, "png": png, "webp": self.webp,
            "surface": self.surface,
        }  # fmt: skip
        files = {kind: path for kind, path in kinds.items() if path is not None}
        for kind, path in files.items():
            option = "--out" if kind == "npz" else f"--{kind}"
            check_drawing(option, path, (".ply" if kind == "surface" else f".{kind}",), [source])
        return files

    def settings(
        self, config: Config, background: str, held_out: bool, *, centre: str | None, outside: bool
    ) -> VolumeSettings:
        """The settings of the volume, with options of the image. Raises UsageError."""
        from tagid.pipeline.volume import VolumeSettings

        return VolumeSettings(
            "bp" if config["imaging.method"] == "auto" else config["imaging.method"],
            config["imaging.extent_m"],
            config["imaging.pixels"],
            None if self.heights is None else parse_point("--heights", self.heights),
            self.levels,
            "none" if background == "reference" else background,
            held_out,
            None if centre is None else parse_point("--centre", centre),
            outside,
        )


def make_volume(
    terminal: Terminal, capture: Capture, settings: VolumeSettings, files: dict[str, Path]
) -> Result:
    """Reconstruct a volume and write it.

    Args:
        capture: loaded.
        settings: of the volume.
        files: to write, by kind, checked.
    """
    from rich.console import Group
    from rich.text import Text

    from tagid.operate.words import held_out_words, outside_words
    from tagid.pipeline.volume import reconstruct_volume

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
        f"{settings.method} volume of {made.views} views from {made.heights} antenna heights, "
        f"{size} in {took:.2f} s",
        f"vertical resolution {1e3 * facts['vertical_resolution_m']:.0f} mm",
        *held_out_words(facts),
        *outside_words(facts),
        *facts.get("warnings", ()),
        *(f"{kind} {path}" for kind, path in files.items()),
    ]
    data: dict[str, Any] = {
        "method": settings.method,
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
            title = f"{volume.settings['method'].upper()} volume"
            draw_projections(volume.values, *axes, path, title, centre_m=volume.centre_m)
        elif kind == "surface":
            write_surface(path, volume)
        elif kind == "webp":
            write_turning(volume.values, *axes, path)
        else:
            write_volume(path, volume)
