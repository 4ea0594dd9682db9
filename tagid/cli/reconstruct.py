"""`tagid reconstruct`: an image from a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing
from tagid.config import load_config
from tagid.counting import counted
from tagid.errors import UsageError
from tagid.query import parse_point
from tagid.result import Result


@command("reconstruct")
def reconstruct(
    terminal: Terminal,
    file: options.CaptureFile,
    method: options.Method = None,
    engine: Annotated[
        str, typer.Option("--engine", help="Engine of ats: native, onnx, torch or auto.")
    ] = "auto",
    device: Annotated[str, typer.Option("--device", help="cpu, or cuda with torch.")] = "cpu",
    calibrate: Annotated[
        str | None,
        typer.Option(
            "--calibrate",
            help="Parameters that ats estimates with the scene: any of axis,wobble,gain,static.",
            show_default=False,
        ),
    ] = None,
    ats: Annotated[
        list[str] | None,
        typer.Option(
            "--ats",
            metavar="KEY=VALUE",
            help="A setting of ats: robust=3, aspect_harmonics=2, occlusion=0.3, steps=200 and more.",
            show_default=False,
        ),
    ] = None,
    extent: options.Extent = None,
    pixels: options.Pixels = None,
    out: Annotated[Path | None, typer.Option("--out", help="Write image and axes (NPZ).")] = None,
    png: options.PngFile = None,
    preview: options.Preview = False,
    motion: options.MotionUrl = None,
    axis_distance: options.AxisDistance = None,
    antenna_height: options.AntennaHeight = None,
    antenna_separation: options.AntennaSeparation = None,
    background: options.Background = "mean",
    focus: Annotated[
        bool,
        typer.Option(help="Estimate the axis distance, or the path delay."),
    ] = True,
    preset: options.Preset = "field",
    pulse: options.Pulse = None,
    centre: options.Centre = None,
    side: options.Side = None,
    wave_speed: options.WaveSpeed = None,
    held_out: Annotated[
        bool, typer.Option(help="Compute how well the image predicts held-out views.")
    ] = True,
    delay_search: options.DelaySearch = None,
    axis_search: options.AxisSearch = None,
    beam: Annotated[
        bool, typer.Option(help="Show sparse images at the resolution of the data, not as single pixels.")
    ] = True,
    subtract_body: Annotated[
        bool,
        typer.Option("--subtract-body", help="Subtract the echo of the body that `identify` finds."),
    ] = False,
    seed: options.Seed = 0,
    volume: Annotated[
        bool,
        typer.Option("--volume", help="Reconstruct a volume from several antenna heights (see `join`)."),
    ] = False,
    heights: Annotated[
        str | None,
        typer.Option(
            "--heights",
            metavar="LOW,HIGH",
            help="Lowest and highest height of the volume, metres.",
            show_default=False,
        ),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option("--levels", help="Number of height levels of the volume.", show_default=False),
    ] = None,
    vti: Annotated[
        Path | None, typer.Option("--vti", help="Write the volume as VTK image data.", show_default=False)
    ] = None,
    ply: Annotated[
        Path | None,
        typer.Option("--ply", help="Write the bright points of the volume as PLY.", show_default=False),
    ] = None,
    surface: Annotated[
        Path | None,
        typer.Option(
            "--surface", help="Write the surface of the volume as PLY triangles.", show_default=False
        ),
    ] = None,
    webp: Annotated[
        Path | None,
        typer.Option("--webp", help="Write an animation of the rotating volume.", show_default=False),
    ] = None,
) -> Result:
    """Reconstruct an image from a capture.

    Example: tagid reconstruct helmet.tagid.h5 --method sparse --png helmet.png
    """
    from dataclasses import replace

    from rich.console import Group, RenderableType
    from rich.text import Text

    from tagid.cli import imaging
    from tagid.imaging.ats.settings import parse_calibrate, parse_settings
    from tagid.imaging.autofocus import BEYOND_SEARCH
    from tagid.operate.turn import draw_image_of
    from tagid.operate.words import SUBTRACTED, learned_words
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.identify import identify, without_body
    from tagid.pipeline.prepared import LoadSettings, PreparedCapture, intake_remarks, load_capture
    from tagid.pipeline.reconstruct import reconstruct as reconstruct_image
    from tagid.storage.image import write_image

    if not volume and (heights or levels or vti or ply or surface or webp):
        raise UsageError(
            "--heights, --levels, --vti, --ply, --surface and --webp apply to volumes only",
            "Add --volume.",
        )
    if not focus and (axis_search is not None or delay_search is not None):
        raise UsageError("--axis-search and --delay-search have no effect with --no-focus", "Omit them.")
    if volume:
        given_for = {
            "--calibrate": calibrate,
            "--ats": ats,
            "--axis-search": axis_search is not None,
            "--delay-search": delay_search is not None,
            "--centre": centre,
            "--side": side,
            "--subtract-body": subtract_body,
        }
        idle = [option for option, asked in given_for.items() if asked]
        if idle:
            raise UsageError(f"no effect on a volume: {', '.join(idle)}", f"Omit {' and '.join(idle)}.")
    if (calibrate or ats) and preset != "field":
        raise UsageError("--calibrate and --ats require --preset field", "Omit them.")
    check_drawing("--png", png, (".png",), [file])
    if not volume:
        check_drawing("--out", out, (".npz",), [file])
    config = load_config(
        {
            "imaging.method": method,
            "imaging.extent_m": extent,
            "imaging.pixels": pixels,
            "imaging.pulse": pulse,
            "motion.url": motion,
            "motion.axis_distance_m": axis_distance,
            "motion.antenna_height_m": antenna_height,
            "motion.antenna_separation_m": antenna_separation,
        }
    )
    if volume:
        from tagid.cli.volume import Asked, Outputs, make_volume

        loading = replace(LoadSettings.of(config, background), wave_speed_m_s=wave_speed)
        outputs = Outputs(out, vti, ply, png, webp, surface)
        outputs.check(file)
        span = None if heights is None else parse_point("--heights", heights)
        asked = Asked(background, span, levels, held_out)
        return make_volume(terminal, load_capture(file, loading), config, asked, outputs)
    place = Workplace(config, background)
    given = place.imaging(focus)
    if (calibrate or ats) and given.method not in ("ats", "auto"):
        raise UsageError(f"--calibrate and --ats have no effect with {given.method}", "Use --method ats.")
    words = [*(ats or ()), *([f"calibrate={'+'.join(parse_calibrate(calibrate))}"] if calibrate else ())]
    settings = replace(
        given,
        seed=seed,
        preset=preset,
        ats=replace(given.ats, engine=engine, device=device, **parse_settings(words)),
        centre_m=None if centre is None else parse_point("--centre", centre),
        towards_m=None if side is None else parse_point("--side", side),
        delay_m=delay_search if focus else 0.0,
        focus_m=axis_search if focus else 0.0,
        restore=beam,
        held_out=held_out,
        free_extent=config.values["imaging.extent_m"].source == "default",
        free_pixels=config.values["imaging.pixels"].source == "default",
    )
    loading = replace(LoadSettings.of(config, background), wave_speed_m_s=wave_speed)
    prepared = PreparedCapture(load_capture(file, loading), settings)
    subtracted = False
    if subtract_body:
        contents = place.registry.contents()
        read = PreparedCapture(prepared.given, given)
        answer = identify(read, contents.layouts, signatures=contents.signatures)
        plain, prepared = prepared, without_body(prepared, answer)
        subtracted = prepared is not plain
    with terminal.progress("image", total=1.0) as advance:
        result = reconstruct_image(prepared, progress=imaging.share_of(advance))
    if out:
        write_image(out, result.image)
    if png:
        draw_image_of(result, None, png)
    lines: list[RenderableType] = []
    if preview:
        lines.append(imaging.in_terminal(result))
    took = sum(result.seconds.values())
    distance = result.image.settings["axis_distance_m"]
    where = "" if distance is None else f", axis at {distance:.3f} m"
    lines.append(Text(f"{result.method} image of {counted(result.views, 'view')} in {took:.2f} s{where}"))
    lines += [Text(line) for line in learned_words(result)]
    if result.focus is not None and result.focus.reason == BEYOND_SEARCH:
        lines.append(Text("--axis-search METRES searches farther"))
    if subtract_body:
        lines.append(Text(SUBTRACTED[subtracted]))
    lines += [Text(f"{name} {path}") for name, path in (("image", out), ("picture", png)) if path]
    data = {
        "method": result.method,
        "image": str(out) if out else None,
        "png": str(png) if png else None,
        "settings": result.image.settings,
        "body_subtracted": subtracted,
        "seconds": result.seconds,
    }
    unseen = not (out or png or preview)
    # The image itself says what is wrong with its samples.
    shown = result.image.settings.get("warnings", ())
    remarks = tuple(note for note in intake_remarks(prepared.given) if note not in shown)
    if unseen:
        remarks += ("the image was not stored: give --out, --png or --preview",)
    return Result("reconstruct", data, Group(*lines), messages=remarks)
