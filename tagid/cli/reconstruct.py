"""`tagid reconstruct`: an image of a recorded scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.config import load_config
from tagid.errors import UsageError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "reconstruct")
    def reconstruct(
        terminal: Terminal,
        file: options.CaptureFile,
        method: options.Method = None,
        engine: Annotated[str, typer.Option("--engine", help="What runs ats: onnx, torch or auto.")] = "auto",
        device: Annotated[str, typer.Option("--device", help="cpu, or cuda with torch.")] = "cpu",
        calibrate: Annotated[
            str | None,
            typer.Option(
                "--calibrate",
                help="What ats learns beside the scene: axis,wobble,gain,static, or some of them.",
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
        background: options.Background = "mean",
        focus: Annotated[
            bool, typer.Option(help="Search the axis distance within 4 cm, or the path delay.")
        ] = True,
        preset: options.Preset = "field",
        pulse: options.Pulse = None,
        centre: options.Centre = None,
        delay_search: options.DelaySearch = 1.0,
        beam: Annotated[
            bool, typer.Option(help="Show sparse images at the data's resolution, not as bare pixels.")
        ] = True,
        subtract_body: Annotated[
            bool,
            typer.Option("--subtract-body", help="Subtract the echo of the body that `identify` finds."),
        ] = False,
        seed: options.Seed = 0,
    ) -> Result:
        """Make an image of a recorded scan.

        Example: tagid reconstruct helmet.tagid.h5 --method sparse --png helmet.png
        """
        from dataclasses import replace

        from rich.console import Group, RenderableType
        from rich.text import Text

        from tagid.cli import imaging
        from tagid.defaults import complete, motion_of, without_reference
        from tagid.imaging.ats.options import parse_calibrate, parse_settings
        from tagid.pipeline import identify, prepare, without_body
        from tagid.storage.image import write_image
        from tagid.storage.importers import read_any

        if (calibrate or ats) and preset != "field":
            raise UsageError("--calibrate and --ats are for --preset field", "Leave them away.")
        config = load_config(
            {
                "imaging.method": method,
                "imaging.extent_m": extent,
                "imaging.pixels": pixels,
                "imaging.pulse": pulse,
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "motion.antenna_height_m": antenna_height,
            }
        )
        given = imaging.settings_from(config, background, focus)
        if (calibrate or ats) and given.method not in ("ats", "auto"):
            raise UsageError(f"--calibrate and --ats do nothing for {given.method}", "Use --method ats.")
        words = [*(ats or ()), *([f"calibrate={'+'.join(parse_calibrate(calibrate))}"] if calibrate else ())]
        settings = replace(
            given,
            seed=seed,
            preset=preset,
            ats=replace(given.ats, engine=engine, device=device, **parse_settings(words)),
            centre_m=imaging.parse_centre(centre),
            delay_m=delay_search if focus else 0.0,
            restore=beam,
            free_size=(
                config.values["imaging.extent_m"].source == "default",
                config.values["imaging.pixels"].source == "default",
            ),
        )
        capture = complete(read_any(file, config["radar.cable_delay_ps"]), config)
        capture = without_reference(capture, config, background)
        capture = prepare(capture, motion_of(config, capture))
        subtracted = False
        if subtract_body:
            answer = identify(capture, imaging.open_registry().layouts(), given)
            plain, capture = capture, without_body(capture, answer)
            subtracted = capture is not plain
        result = imaging.image_with_progress(terminal, capture, settings)
        if out:
            write_image(out, result.image)
        if png:
            imaging.draw(result, None, png)
        lines: list[RenderableType] = []
        if preview:
            lines.append(imaging.in_terminal(result))
        took = sum(result.seconds.values())
        distance = result.image.settings["axis_distance_m"]
        where = "" if distance is None else f", axis at {distance:.3f} m"
        lines.append(Text(f"{result.method} image of {result.views} views in {took:.2f} s{where}"))
        lines += [Text(line) for line in imaging.learned_words(result)]
        if subtract_body:
            lines.append(Text(imaging.SUBTRACTED[subtracted]))
        lines += [Text(f"{name} {path}") for name, path in (("image", out), ("picture", png)) if path]
        data = {
            "method": result.method,
            "image": str(out) if out else None,
            "png": str(png) if png else None,
            "settings": result.image.settings,
            "body_subtracted": subtracted,
            "seconds": result.seconds,
        }
        return Result("reconstruct", data, Group(*lines))
