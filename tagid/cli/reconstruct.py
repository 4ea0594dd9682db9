"""`tagid reconstruct`: an image, or a volume, from a capture."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES
from tagid.cli.outputs import check_drawing
from tagid.config import Config, load_config
from tagid.counting import counted
from tagid.errors import UsageError
from tagid.query import parse_point
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.imaging.volume import Volume
    from tagid.pipeline.settings import ImagingSettings
    from tagid.pipeline.volume import VolumeSettings
    from tagid.result import Drawn


@dataclass(frozen=True)
class _MethodOptions:
    """The method of the image, and what ats assumes."""

    method: options.Method = None
    engine: Annotated[str, typer.Option(help="Engine of ats: native, onnx, torch or auto.")] = "auto"
    device: Annotated[str, typer.Option(help="cpu, or cuda with torch.")] = "cpu"
    calibrate: Annotated[
        str | None,
        typer.Option(help="Parameters that ats estimates with the scene: any of axis,wobble,gain,static."),
    ] = None
    ats: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="A setting of ats: prior=dense, robust=3, steps=200 and more.",
        ),
    ] = None


@dataclass(frozen=True)
class _PictureOptions:
    extent: Annotated[
        float | None, typer.Option(parser=METRES, help="Width and height of the image, metres.")
    ] = None
    pixels: Annotated[int | None, typer.Option(help="Pixels per side.")] = None
    out: Annotated[Path | None, typer.Option(help="Write image and axes (NPZ).")] = None
    png: options.PngFile = None
    preview: options.Preview = False


@dataclass(frozen=True)
class _ImageOptions:
    focus: Annotated[bool, typer.Option(help="Estimate the axis distance, or the path delay.")] = True
    preset: Annotated[str, typer.Option(help="Variant of ats: field, or paper (as published, slow).")] = (
        "field"
    )
    pulse: Annotated[
        str | None,
        typer.Option(help="auto (the capture's or nominal), nominal, or estimate (from the scans)."),
    ] = None
    centre: Annotated[
        str | None,
        typer.Option(
            help="Centre of the image or volume as X,Y in metres, for captures with antenna positions."
        ),
    ] = None
    side: Annotated[
        str | None, typer.Option(help="A point X,Y in metres on the side of a straight path to be imaged.")
    ] = None
    wave_speed: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=3.1e08,
            help="Speed of the wave in the medium (m/s): 345 for sound in air, 1.06e8 at a permittivity of "
            "8. Default: value in the file, or vacuum.",
        ),
    ] = None
    held_out: Annotated[bool, typer.Option(help="Compute how well the image predicts held-out views.")] = True
    delay_search: Annotated[
        float | None,
        typer.Option(
            parser=METRES,
            help="Half-width of the path-delay search (m), for captures with antenna positions. "
            "Default: 13 wavelengths, 1 m for a P440.",
        ),
    ] = None
    axis_search: Annotated[
        float | None,
        typer.Option(
            parser=METRES,
            help="Half-width of the axis-distance search (m), for turntables. "
            "Default: half a wavelength, 0.04 m for a P440; at most two.",
        ),
    ] = None
    beam: Annotated[
        bool, typer.Option(help="Show sparse images at the resolution of the data, not as single pixels.")
    ] = True
    subtract_body: Annotated[
        bool, typer.Option("--subtract-body", help="Subtract the echo of the body that `identify` finds.")
    ] = False
    seed: options.Seed = 0
    outside: Annotated[
        bool, typer.Option(help="Search echoes from outside the image; sparse, omp and ats subtract them.")
    ] = True


@dataclass(frozen=True)
class _VolumeOptions:
    """The volume of `tagid reconstruct --volume` and the files that it is written to."""

    volume: Annotated[
        bool, typer.Option("--volume", help="Reconstruct a volume from several antenna heights (see `join`).")
    ] = False
    heights: Annotated[
        str | None, typer.Option(metavar="LOW,HIGH", help="Lowest and highest height of the volume, metres.")
    ] = None
    levels: Annotated[int | None, typer.Option(help="Number of height levels of the volume.")] = None
    vti: Annotated[Path | None, typer.Option(help="Write the volume as VTK image data.")] = None
    ply: Annotated[Path | None, typer.Option(help="Write the bright points of the volume as PLY.")] = None
    surface: Annotated[
        Path | None, typer.Option(help="Write the surface of the volume as PLY triangles.")
    ] = None
    webp: Annotated[Path | None, typer.Option(help="Write an animation of the rotating volume.")] = None

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


@command("reconstruct")
def reconstruct(
    terminal: Terminal,
    file: options.CaptureFile,
    how: _MethodOptions,
    picture: _PictureOptions,
    setup: options.RecordedOptions,
    wanted: _ImageOptions,
    volume: _VolumeOptions,
) -> Result:
    """Reconstruct an image from a capture.

    Example: tagid reconstruct helmet.tagid.h5 --method sparse --png helmet.png
    """
    from tagid.cli import imaging
    from tagid.imaging.autofocus import BEYOND_SEARCH
    from tagid.operate.turn import draw_image_of
    from tagid.operate.words import SUBTRACTED, learned_words
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.identify import identify, without_body
    from tagid.pipeline.prepared import LoadSettings, PreparedCapture, intake_remarks, load_capture
    from tagid.pipeline.reconstruct import reconstruct as reconstruct_image
    from tagid.report.arrays import write_image

    _check_combined(how, wanted, volume)
    check_drawing("--png", picture.png, (".png",), [file])
    if not volume.volume:
        check_drawing("--out", picture.out, (".npz",), [file])
    config = load_config(
        {
            "imaging.method": how.method,
            "imaging.extent_m": picture.extent,
            "imaging.pixels": picture.pixels,
            "imaging.pulse": wanted.pulse,
            **setup.settings(),
        }
    )
    loading = replace(LoadSettings.of(config, setup.background), wave_speed_m_s=wanted.wave_speed)
    if volume.volume:
        files = volume.files(picture.out, picture.png, file)
        levels = volume.settings(
            config, setup.background, wanted.held_out, centre=wanted.centre, outside=wanted.outside
        )
        return _volume(terminal, load_capture(file, loading), levels, files)
    place = Workplace(config, setup.background)
    plain = place.imaging(wanted.focus)
    settings = _settings(plain, config, how, wanted)
    prepared = PreparedCapture(load_capture(file, loading), settings)
    subtracted = False
    if wanted.subtract_body:
        contents = place.registry.contents()
        read = PreparedCapture(prepared.given, plain)
        answer = identify(read, contents.layouts, signatures=contents.signatures)
        whole, prepared = prepared, without_body(prepared, answer)
        subtracted = prepared is not whole
    with terminal.progress("image", total=1.0) as advance:
        result = reconstruct_image(prepared, progress=imaging.share_of(advance))
    if picture.out:
        write_image(picture.out, result.image)
    if picture.png:
        draw_image_of(result, None, picture.png)
    lines: list[Drawn] = []
    if picture.preview:
        lines.append(imaging.in_terminal(result))
    took = sum(result.seconds.values())
    distance = result.image.settings["axis_distance_m"]
    where = "" if distance is None else f", axis at {distance:.3f} m"
    lines.append(f"{result.method} image of {counted(result.views, 'view')} in {took:.2f} s{where}")
    lines += learned_words(result)
    if result.focus is not None and result.focus.reason == BEYOND_SEARCH:
        lines.append("--axis-search METRES searches farther; --antenna-height METRES raises the antenna")
    if wanted.subtract_body:
        lines.append(SUBTRACTED[subtracted])
    lines += [f"{name} {path}" for name, path in (("image", picture.out), ("picture", picture.png)) if path]
    data = {
        "method": result.method,
        "image": str(picture.out) if picture.out else None,
        "png": str(picture.png) if picture.png else None,
        "settings": result.image.settings,
        "body_subtracted": subtracted,
        "seconds": result.seconds,
    }
    unseen = not (picture.out or picture.png or picture.preview)
    # The image itself says what is wrong with its samples.
    shown = result.image.settings.get("warnings", ())
    remarks = tuple(note for note in intake_remarks(prepared.given) if note not in shown)
    if unseen:
        remarks += ("the image was not stored: give --out, --png or --preview",)
    return Result("reconstruct", data, lines, messages=remarks)


def _check_combined(how: _MethodOptions, wanted: _ImageOptions, volume: _VolumeOptions) -> None:
    """Raises UsageError: options that have no effect together."""
    if not volume.volume and volume.given:
        raise UsageError(
            "--heights, --levels, --vti, --ply, --surface and --webp apply to volumes only", "Add --volume."
        )
    if not wanted.focus and (wanted.axis_search is not None or wanted.delay_search is not None):
        raise UsageError("--axis-search and --delay-search have no effect with --no-focus", "Omit them.")
    if volume.volume:
        given_for = {
            "--calibrate": how.calibrate,
            "--ats": how.ats,
            "--axis-search": wanted.axis_search is not None,
            "--delay-search": wanted.delay_search is not None,
            "--side": wanted.side,
            "--subtract-body": wanted.subtract_body,
        }
        if idle := _given_among(given_for):
            raise UsageError(f"no effect on a volume: {', '.join(idle)}", f"Omit {' and '.join(idle)}.")
    if (how.calibrate or how.ats) and wanted.preset != "field":
        raise UsageError("--calibrate and --ats require --preset field", "Omit them.")


def _given_among(options: Mapping[str, object]) -> list[str]:
    return [option for option, given in options.items() if given]


def _settings(
    plain: ImagingSettings, config: Config, how: _MethodOptions, wanted: _ImageOptions
) -> ImagingSettings:
    """The settings of an image from those of the configuration. Raises UsageError."""
    from tagid.imaging.ats.settings import parse_calibrate, parse_settings

    for_ats = {
        "--calibrate": how.calibrate,
        "--ats": how.ats,
        "--device": how.device != "cpu",
        "--preset": wanted.preset != "field",
    }
    if plain.method not in ("ats", "auto") and (idle := _given_among(for_ats)):
        raise UsageError(f"no effect with {plain.method}: {', '.join(idle)}", "Use --method ats.")
    calibrate = [f"calibrate={'+'.join(parse_calibrate(how.calibrate))}"] if how.calibrate else []
    learned = parse_settings([*(how.ats or ()), *calibrate])
    return replace(
        plain,
        seed=wanted.seed,
        preset=wanted.preset,
        ats=replace(plain.ats, engine=how.engine, device=how.device, **learned),
        centre_m=None if wanted.centre is None else parse_point("--centre", wanted.centre),
        towards_m=None if wanted.side is None else parse_point("--side", wanted.side),
        delay_m=wanted.delay_search if wanted.focus else 0.0,
        focus_m=wanted.axis_search if wanted.focus else 0.0,
        restore=wanted.beam,
        held_out=wanted.held_out,
        outside=wanted.outside,
        free_extent=config.values["imaging.extent_m"].source == "default",
        free_pixels=config.values["imaging.pixels"].source == "default",
    )


def _volume(terminal: Terminal, capture: Capture, settings: VolumeSettings, files: dict[str, Path]) -> Result:
    """Reconstruct a volume and write it to files, by kind, which were checked."""
    from tagid.imaging.facts import facts_of
    from tagid.operate.words import held_out_words, outside_words
    from tagid.pipeline.volume import reconstruct_volume

    begun = time.monotonic()
    with terminal.progress("volume", total=1.0) as advance:

        def progress(done: float, total: float, remark: str) -> None:
            part = done / max(total, 1)
            remaining_s = (time.monotonic() - begun) * (1 / part - 1) if part > 0 else 0.0
            advance(part, f"{remaining_s:.0f} s left" if part < 1 else "")

        made = reconstruct_volume(capture, settings, progress)
    _write_volume(made.volume, files)
    facts = made.volume.settings
    took = sum(made.seconds.values())
    grid = made.volume.grid
    size = f"{grid.square.pixels} x {grid.square.pixels} x {grid.levels} voxels"
    lines = [
        f"{settings.method} volume of {made.views} views from {made.heights} antenna heights, "
        f"{size} in {took:.2f} s",
        f"vertical resolution {1e3 * facts['vertical_resolution_m']:.0f} mm",
        *held_out_words(facts_of(facts)),
        *outside_words(facts_of(facts)),
        *facts.get("warnings", ()),
        *(f"{kind} {path}" for kind, path in files.items()),
    ]
    data: dict[str, Any] = {
        "method": settings.method,
        "settings": facts,
        "files": {kind: str(path) for kind, path in files.items()},
        "seconds": made.seconds,
    }
    return Result("reconstruct", data, lines)


def _write_volume(volume: Volume, files: dict[str, Path]) -> None:
    from tagid.report.arrays import write_surface, write_volume
    from tagid.report.volume_picture import draw_projections, write_turning

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
