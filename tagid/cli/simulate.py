"""`tagid simulate`: captures of simulated scenes and of objects whose response is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options, response_options
from tagid.cli.frame import Terminal, command
from tagid.errors import DataError, StorageError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Pulse


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "simulate")
    def simulate(
        terminal: Terminal,
        out: Annotated[Path, typer.Option("--out", "-o", help="Capture to write.")],
        scene: Annotated[
            str | None,
            typer.Argument(help="helmet-120, container-90, points-3, can, box, empty ...; or --response."),
        ] = None,
        response: response_options.ResponseFile = None,
        polarisation: response_options.Polarisation = None,
        snr_reference: response_options.SnrReference = None,
        snr_reference_body: response_options.SnrReferenceBody = None,
        pulse_of: Annotated[
            Path | None, typer.Option("--pulse-of", help="Capture that holds the pulse to transmit.")
        ] = None,
        views: Annotated[int, typer.Option("--views", help="Views a turn.")] = 360,
        turns: Annotated[float, typer.Option("--turns", help="Turns recorded.")] = 1.0,
        snr: Annotated[float | None, typer.Option("--snr", help="dB a sample, strongest echo.")] = 20.0,
        noise: Annotated[float | None, typer.Option("--noise", help="Noise std instead of --snr.")] = None,
        axis_distance: Annotated[float, typer.Option("--axis-distance", help="Radar to axis, metres.")] = 1.0,
        axis_error: Annotated[float, typer.Option("--axis-error", help="Told minus true distance, m.")] = 0.0,
        height: Annotated[float, typer.Option("--antenna-height", help="Metres.")] = 0.0,
        rotation: Annotated[float, typer.Option("--rotation", help="Turn of the object, degrees.")] = 0.0,
        centre: Annotated[str, typer.Option("--centre", help="X,Y off the axis, metres.")] = "0,0",
        wobble: Annotated[float, typer.Option("--wobble", help="Uneven speed, 0.01 is 1 %.")] = 0.0,
        beam_deg: Annotated[float | None, typer.Option("--beam", help="-3 dB beam width, degrees.")] = None,
        range_law: Annotated[bool, typer.Option("--range-law", help="1/R^4 in power.")] = False,
        seed: options.Seed = 0,
        force: Annotated[bool, typer.Option("--force", help="Write over a file that exists.")] = False,
    ) -> Result:
        """Simulate the capture of a turning scene, or of an object whose response is in a file.

        Example: tagid simulate helmet-120 --snr 10 --views 36 --out helmet.tagid.h5
        """
        import numpy as np
        from rich.text import Text

        from tagid.cli.enroll import parse_point
        from tagid.simulate import Acquisition, Placement, Wobble, scene_from_name, simulate_capture
        from tagid.storage.exporters import export

        if out.exists() and not force:
            raise StorageError(f"{out} exists already", "Choose another name, or add --force.")
        files = response_options.response_files(response, polarisation, snr_reference, snr_reference_body)
        if (scene is None) == (files is None):
            raise UsageError("give either a scene or --response FILE", "tagid simulate --help has examples.")
        if files is not None and range_law:
            raise UsageError("--range-law is part of every response", "Omit --range-law.")
        acquisition = Acquisition(
            views=views,
            turns=turns,
            axis_distance_m=axis_distance,
            axis_distance_error_m=axis_error,
            antenna_height_m=height,
            snr_db=None if noise is not None else snr,
            noise_std=noise,
            placement=Placement(parse_point("--centre", centre), float(np.deg2rad(rotation))),
            wobble=Wobble(speed=wobble),
            beam_width_rad=None if beam_deg is None else float(np.deg2rad(beam_deg)),
            range_law=range_law,
            pulse=None if pulse_of is None else _pulse_of(pulse_of),
        )
        shown = scene_from_name(scene or "", seed) if files is None else files.scene(acquisition, seed)
        capture, truth = simulate_capture(shown, acquisition, seed)
        export(capture, out)
        line = Text(f"{out}: {shown.name}, {capture.views} scans of {capture.bins} samples")
        data = {
            "path": str(out),
            "scene": shown.name,
            "views": capture.views,
            "bins": capture.bins,
            "truth": {
                "axis_distance_m": truth.axis_distance_m,
                "positions_m": truth.positions_m,
                "noise_std": truth.noise_std,
            },
        }
        return Result("simulate", data, line)


def _pulse_of(path: Path) -> Pulse:
    """The pulse that a capture holds. Raises the reader's errors, and DataError where it holds none."""
    from tagid.storage.importers import read_any

    pulse = read_any(path).pulse
    if pulse is None:
        raise DataError(f"{path} holds no pulse", "Give a capture with `pulse` and `pulse_step_s`.")
    return pulse
