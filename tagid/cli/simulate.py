"""`tagid simulate`: captures of simulated scenes and of objects with a response file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES, SceneOptions
from tagid.cli.outputs import check_new
from tagid.counting import counted
from tagid.errors import DataError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Pulse

PULSES = ("nominal", "random")


@dataclass(frozen=True)
class _SceneOptions(SceneOptions):
    scene: Annotated[
        str | None, typer.Option(help="An enrolled layout, points-3, can, box, empty ...; or --response.")
    ] = None
    unlike: Annotated[float, typer.Option(help="Spread of the reflectors' strengths, 0 to 20 dB.")] = 0.0
    noise: Annotated[float | None, typer.Option(help="Noise standard deviation; replaces --snr.")] = None
    antenna_height: Annotated[float, typer.Option(parser=METRES, help="Metres.")] = 0.0
    antenna_separation: options.AntennaSeparation = 0.0
    range_law: Annotated[bool, typer.Option("--range-law", help="1/R^4 in power.")] = False


@dataclass(frozen=True)
class _RecordingOptions:
    pulse_of: Annotated[Path | None, typer.Option(help="Capture with the pulse to transmit.")] = None
    views: Annotated[int, typer.Option(help="Views per revolution.")] = 360
    turns: Annotated[float, typer.Option(help="Turns recorded.")] = 1.0
    snr_of: Annotated[
        str, typer.Option(help="Echo to which --snr refers: reflector (the strongest), or summed (all).")
    ] = "reflector"
    colour: Annotated[
        float, typer.Option("--noise-colour", help="Share of noise in the radar's band, 0 to 1.")
    ] = 0.0
    interference: Annotated[float | None, typer.Option(help="Narrow-band tone, dB above the noise.")] = None
    pulse: Annotated[str, typer.Option(help="nominal, or random (not stated in the capture).")] = "nominal"
    axis_error: Annotated[float, typer.Option(parser=METRES, help="Stated minus true distance, m.")] = 0.0
    beam: Annotated[float | None, typer.Option(help="-3 dB beam width, degrees.")] = None
    object_seed: Annotated[
        int | None,
        typer.Option(
            help="Random seed of object and room alone, to record one object with different --seed.", min=0
        ),
    ] = None


@command("simulate")
def simulate(
    terminal: Terminal,
    out: Annotated[Path, typer.Option("--out", "-o", help="Capture to write.")],
    scene: _SceneOptions,
    recording: _RecordingOptions,
    scene_name: Annotated[str | None, typer.Argument(help="Another way to give --scene.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> Result:
    """Simulate a capture of a rotating scene, or of an object with a response file.

    Example: tagid simulate --scene container-90 --body can:35mm,handle --centre 0.004,0 --out can.tagid.h5
    """
    import numpy as np

    from tagid.enrolling.layout_file import only_layout
    from tagid.simulate import Interference, NoiseShape, simulate_capture
    from tagid.storage.exporters import export

    check_new(out, force)
    if scene_name is not None and scene.scene is not None:
        raise UsageError("the scene is given twice", "Give --scene alone.")
    name, tone = scene.scene or scene_name, recording.interference
    if name is None and scene.file is not None:
        name = only_layout(scene.file)
    seed = scene.seed if recording.object_seed is None else recording.object_seed
    shown, acquisition = scene.spec(scene=name, seed=seed).build(
        views=recording.views,
        turns=recording.turns,
        axis_distance_error_m=recording.axis_error,
        pulse=_pulse(recording, scene.seed),
        snr_reference=recording.snr_of,
        noise=NoiseShape(recording.colour, None if tone is None else Interference(tone)),
        beam_width_rad=None if recording.beam is None else float(np.deg2rad(recording.beam)),
    )
    capture, truth = simulate_capture(shown, acquisition, scene.seed)
    export(capture, out)
    line = f"{out}: {shown.name}, {counted(capture.views, 'scan')} of {capture.bins} samples, {truth.snr}"
    data = {
        "path": str(out),
        "scene": shown.name,
        "views": capture.views,
        "bins": capture.bins,
        "truth": {
            "axis_distance_m": truth.axis_distance_m,
            "positions_m": truth.positions_m,
            "noise_std": truth.noise_std,
            "snr_db": truth.snr.changing_db,
            "snr_reflector_db": truth.snr.reflector_db,
            "snr_summed_db": truth.snr.summed_db,
            "snr_reference_db": truth.snr.reference_db,
            "snr_reference": truth.snr.reference or None,
        },
    }
    return Result("simulate", data, line)


def _pulse(recording: _RecordingOptions, seed: int) -> Pulse | None:
    """The received pulse; None for the nominal one. Raises the reader's errors, and DataError without one."""
    import numpy as np

    from tagid.simulate import random_pulse
    from tagid.storage.importers import read_any

    if recording.pulse_of is not None:
        pulse = read_any(recording.pulse_of).pulse
        if pulse is None:
            raise DataError(
                f"{recording.pulse_of} contains no pulse", "Give a capture with `pulse` and `pulse_step_s`."
            )
        return pulse
    if recording.pulse not in PULSES:
        raise UsageError(f"--pulse is {recording.pulse!r}", f"Use {' or '.join(PULSES)}.")
    # A separate random stream, so that the pulse depends only on the seed.
    return random_pulse(np.random.default_rng([seed, 1])) if recording.pulse == "random" else None
