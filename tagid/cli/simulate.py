"""`tagid simulate`: captures of simulated scenes and of objects with a response file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import options, response_options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_new
from tagid.counting import counted
from tagid.errors import DataError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Pulse
    from tagid.simulate import Scene

PULSES = ("nominal", "random")
MAX_UNLIKE_DB = 20.0


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "simulate")
    def simulate(
        terminal: Terminal,
        out: Annotated[Path, typer.Option("--out", "-o", help="Capture to write.")],
        body: options.Body = None,
        reflector: options.Reflector = None,
        elevation: options.Elevation = "0m",
        unlike: Annotated[
            float, typer.Option("--unlike", help="Spread of the reflectors' strengths, 0 to 20 dB.")
        ] = 0.0,
        scene: Annotated[
            str | None,
            typer.Argument(help="An enrolled layout, points-3, can, box, empty ...; or --response."),
        ] = None,
        file: options.LayoutFile = None,
        response: response_options.ResponseFile = None,
        polarisation: response_options.Polarisation = None,
        snr_reference: response_options.SnrReference = None,
        snr_reference_body: response_options.SnrReferenceBody = None,
        pulse_of: Annotated[
            Path | None, typer.Option("--pulse-of", help="Capture with the pulse to transmit.")
        ] = None,
        views: Annotated[int, typer.Option("--views", help="Views per revolution.")] = 360,
        turns: Annotated[float, typer.Option("--turns", help="Turns recorded.")] = 1.0,
        snr: Annotated[
            float | None, typer.Option("--snr", help="Ratio of peak echo to noise of one sample, dB.")
        ] = 20.0,
        snr_of: Annotated[
            str,
            typer.Option(
                "--snr-of", help="Echo to which --snr refers: reflector (the strongest), or summed (all)."
            ),
        ] = "reflector",
        noise: Annotated[
            float | None, typer.Option("--noise", help="Noise standard deviation; replaces --snr.")
        ] = None,
        colour: Annotated[
            float, typer.Option("--noise-colour", help="Share of noise in the radar's band, 0 to 1.")
        ] = 0.0,
        interference: Annotated[
            float | None,
            typer.Option("--interference", help="Narrow-band tone, dB above the noise.", show_default=False),
        ] = None,
        pulse: Annotated[
            str, typer.Option("--pulse", help="nominal, or random (not stated in the capture).")
        ] = "nominal",
        axis_distance: Annotated[float, typer.Option("--axis-distance", help="Radar to axis, metres.")] = 1.0,
        axis_error: Annotated[
            float, typer.Option("--axis-error", help="Stated minus true distance, m.")
        ] = 0.0,
        height: Annotated[float, typer.Option("--antenna-height", help="Metres.")] = 0.0,
        antenna_separation: options.AntennaSeparation = None,
        rotation: Annotated[
            float, typer.Option("--rotation", min=-1e06, max=1e06, help="Rotation of the object, degrees.")
        ] = 0.0,
        centre: options.ObjectCentre = "0,0",
        wobble: Annotated[float, typer.Option("--wobble", help="Variation of the speed; 0.01 is 1 %.")] = 0.0,
        beam_deg: Annotated[float | None, typer.Option("--beam", help="-3 dB beam width, degrees.")] = None,
        range_law: Annotated[bool, typer.Option("--range-law", help="1/R^4 in power.")] = False,
        seed: Annotated[
            int,
            typer.Option(
                "--seed",
                help="Random seed of noise and wobble and, unless --object-seed is given, of the object: "
                "also where a handle or seam is relative to the tag.",
                min=0,
            ),
        ] = 0,
        object_seed: Annotated[
            int | None,
            typer.Option(
                "--object-seed",
                help="Random seed of object and room alone, to record one object with different --seed.",
                min=0,
                show_default=False,
            ),
        ] = None,
        force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
    ) -> Result:
        """Simulate a capture of a rotating scene, or of an object with a response file.

        Example: tagid simulate container-90 --body can:35mm,handle --centre 0.004,0 --out can.tagid.h5
        """
        import numpy as np
        from rich.text import Text

        from tagid.cli.common.points import parse_point
        from tagid.simulate import (
            Acquisition,
            Interference,
            NoiseShape,
            Placement,
            Wobble,
            parse_elevation,
            simulate_capture,
        )
        from tagid.storage.exporters import export

        if not 0 <= unlike <= MAX_UNLIKE_DB:  # Click compares with the limits, which NaN passes
            raise UsageError(f"--unlike is {unlike:g} dB", f"Give 0 to {MAX_UNLIKE_DB:g} dB.")
        check_new(out, force)
        place = Placement(
            parse_point("--centre", centre), float(np.deg2rad(rotation)), parse_elevation(elevation)
        )
        files = response_options.response_files(response, polarisation, snr_reference, snr_reference_body)
        if file is not None and scene is None:
            from tagid.tags.enrolling.lookup import only_layout

            scene = only_layout(file)
        if (scene is None) == (files is None):
            raise UsageError("give either a scene or --response FILE", "tagid simulate --help has examples.")
        if files is not None:
            physical = {"--body": body is not None, "--reflector": reflector is not None}
            given = {**physical, "--unlike": unlike != 0, "--range-law": range_law}
            response_options.check_with_response(given)
        acquisition = Acquisition(
            views=views,
            turns=turns,
            axis_distance_m=axis_distance,
            axis_distance_error_m=axis_error,
            antenna_height_m=height,
            antenna_separation_m=antenna_separation or 0.0,
            pulse=_pulse(pulse, seed) if pulse_of is None else _pulse_of(pulse_of),
            snr_db=None if noise is not None else snr,
            snr_reference=snr_of,
            noise_std=noise,
            noise=NoiseShape(colour, None if interference is None else Interference(interference)),
            placement=place,
            wobble=Wobble(speed=wobble),
            beam_width_rad=None if beam_deg is None else float(np.deg2rad(beam_deg)),
            range_law=range_law,
        )
        of_object = seed if object_seed is None else object_seed
        if files is None:
            shown = _scene(scene or "", _Carrier(body, reflector, unlike), of_object, file)
        else:
            shown = files.scene(acquisition, of_object)
        capture, truth = simulate_capture(shown, acquisition, seed)
        export(capture, out)
        line = Text(
            f"{out}: {shown.name}, {counted(capture.views, 'scan')} of {capture.bins} samples, {truth.snr}"
        )
        data = {
            "path": str(out),
            "scene": shown.name,
            "views": capture.views,
            "bins": capture.bins,
            "truth": {
                "axis_distance_m": truth.axis_distance_m,
                "positions_m": truth.positions_m,
                "noise_std": truth.noise_std,
                "snr_reflector_db": truth.snr.reflector_db,
                "snr_summed_db": truth.snr.summed_db,
                "snr_reference_db": truth.snr.reference_db,
                "snr_reference": truth.snr.reference or None,
            },
        }
        return Result("simulate", data, line)


@dataclass(frozen=True)
class _Carrier:
    """Body and reflectors as the command line names them, and the spread of the reflectors' strengths, dB."""

    body: str | None
    reflector: str | None
    unlike_db: float


def _scene(name: str, on: _Carrier, seed: int, file: Path | None) -> Scene:
    """The preset, or its tag on a physical body if one of the options requests it."""
    from tagid.config import data_folder
    from tagid.simulate import parse_body, parse_reflector, scene_from_name, scene_on_body
    from tagid.simulate.presets import is_plain
    from tagid.tags.enrolling.lookup import named_layouts

    layouts = None if is_plain(name) else named_layouts(file, data_folder() / "registry.sqlite")
    if on.body is None and on.reflector is None:
        if on.unlike_db:
            raise UsageError("--unlike needs physical reflectors", "Add --reflector octahedron:20mm.")
        return scene_from_name(name, seed, layouts)
    body, reflector = parse_body(on.body or "none"), parse_reflector(on.reflector or "octahedron")
    return scene_on_body(name, body, reflector, seed, on.unlike_db, layouts)


def _pulse(name: str, seed: int) -> Pulse | None:
    """The received pulse; None for the nominal one."""
    import numpy as np

    from tagid.simulate import random_pulse

    if name not in PULSES:
        raise UsageError(f"--pulse is {name!r}", f"Use {' or '.join(PULSES)}.")
    # A separate random stream, so that the pulse depends only on the seed.
    return random_pulse(np.random.default_rng([seed, 1])) if name == "random" else None


def _pulse_of(path: Path) -> Pulse:
    """The pulse stored in a capture. Raises the reader's errors, and DataError if it has none."""
    from tagid.storage.importers import read_any

    pulse = read_any(path).pulse
    if pulse is None:
        raise DataError(f"{path} contains no pulse", "Give a capture with `pulse` and `pulse_step_s`.")
    return pulse
