"""`tagid reconstruct`: an image from a capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing
from tagid.cli.volume import VolumeOptions, make_volume
from tagid.config import Config, load_config
from tagid.counting import counted
from tagid.errors import UsageError
from tagid.query import parse_point
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.pipeline.settings import ImagingSettings


@dataclass(frozen=True)
class _MethodOptions:
    """The method of the image, and what ats assumes."""

    method: options.Method = None
    engine: Annotated[str, typer.Option("--engine", help="Engine of ats: native, onnx, torch or auto.")] = (
        "auto"
    )
    device: Annotated[str, typer.Option("--device", help="cpu, or cuda with torch.")] = "cpu"
    calibrate: Annotated[
        str | None,
        typer.Option(
            "--calibrate",
            help="Parameters that ats estimates with the scene: any of axis,wobble,gain,static.",
        ),
    ] = None
    ats: Annotated[
        list[str] | None,
        typer.Option(
            "--ats",
            metavar="KEY=VALUE",
            help="A setting of ats: robust=3, aspect_harmonics=2, occlusion=0.3, steps=200 and more.",
        ),
    ] = None


@dataclass(frozen=True)
class _PictureOptions:
    """The size of the image and where it goes."""

    extent: options.Extent = None
    pixels: options.Pixels = None
    out: Annotated[Path | None, typer.Option("--out", help="Write image and axes (NPZ).")] = None
    png: options.PngFile = None
    preview: options.Preview = False


@dataclass(frozen=True)
class _ImageOptions:
    """How the scans become the image."""

    focus: Annotated[bool, typer.Option(help="Estimate the axis distance, or the path delay.")] = True
    preset: options.Preset = "field"
    pulse: options.Pulse = None
    centre: options.Centre = None
    side: options.Side = None
    wave_speed: options.WaveSpeed = None
    held_out: Annotated[bool, typer.Option(help="Compute how well the image predicts held-out views.")] = True
    delay_search: options.DelaySearch = None
    axis_search: options.AxisSearch = None
    beam: Annotated[
        bool, typer.Option(help="Show sparse images at the resolution of the data, not as single pixels.")
    ] = True
    subtract_body: Annotated[
        bool, typer.Option("--subtract-body", help="Subtract the echo of the body that `identify` finds.")
    ] = False
    seed: options.Seed = 0
    outside: Annotated[
        bool, typer.Option(help="Search echoes from outside the image; sparse and ats subtract them.")
    ] = True


@command("reconstruct")
def reconstruct(
    terminal: Terminal,
    file: options.CaptureFile,
    how: _MethodOptions,
    picture: _PictureOptions,
    setup: options.RecordedOptions,
    wanted: _ImageOptions,
    volume: VolumeOptions,
) -> Result:
    """Reconstruct an image from a capture.

    Example: tagid reconstruct helmet.tagid.h5 --method sparse --png helmet.png
    """
    from rich.console import Group, RenderableType
    from rich.text import Text

    from tagid.cli import imaging
    from tagid.imaging.autofocus import BEYOND_SEARCH
    from tagid.operate.turn import draw_image_of
    from tagid.operate.words import SUBTRACTED, learned_words
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.identify import identify, without_body
    from tagid.pipeline.prepared import LoadSettings, PreparedCapture, intake_remarks, load_capture
    from tagid.pipeline.reconstruct import reconstruct as reconstruct_image
    from tagid.storage.image import write_image

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
        return make_volume(terminal, load_capture(file, loading), levels, files)
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
    lines: list[RenderableType] = []
    if picture.preview:
        lines.append(imaging.in_terminal(result))
    took = sum(result.seconds.values())
    distance = result.image.settings["axis_distance_m"]
    where = "" if distance is None else f", axis at {distance:.3f} m"
    lines.append(Text(f"{result.method} image of {counted(result.views, 'view')} in {took:.2f} s{where}"))
    lines += [Text(line) for line in learned_words(result)]
    if result.focus is not None and result.focus.reason == BEYOND_SEARCH:
        lines.append(
            Text("--axis-search METRES searches farther; --antenna-height METRES raises the antenna")
        )
    if wanted.subtract_body:
        lines.append(Text(SUBTRACTED[subtracted]))
    lines += [
        Text(f"{name} {path}") for name, path in (("image", picture.out), ("picture", picture.png)) if path
    ]
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
    return Result("reconstruct", data, Group(*lines), messages=remarks)


def _check_combined(how: _MethodOptions, wanted: _ImageOptions, volume: VolumeOptions) -> None:
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
    """The options that were given."""
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
