"""Options of `tagid simulate` and `tagid emulate p440` for the scene, each defined once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli.common import options
from tagid.query import parse_point

if TYPE_CHECKING:
    from tagid.simulate import SceneSpec


@dataclass(frozen=True)
class SceneOptions:
    """The options that both commands share, by the names of `SceneSpec`."""

    file: options.LayoutFile = None
    response: Annotated[
        Path | None,
        typer.Option(
            "--response", help="Response file of the object, instead of a scene (docs/responses.md)."
        ),
    ] = None
    polarisation: Annotated[
        str | None, typer.Option("--polarisation", help="With --response: V (default) or H.")
    ] = None
    snr_reference: Annotated[
        Path | None,
        typer.Option("--snr-reference", help="With --response: response whose peak --snr refers to."),
    ] = None
    snr_reference_body: Annotated[
        Path | None,
        typer.Option("--snr-reference-body", help="Response subtracted from --snr-reference."),
    ] = None
    body: options.Body = None
    reflector: options.Reflector = None
    elevation: Annotated[
        str,
        typer.Option(
            "--elevation",
            help="Height of the tag above the stated plane, e.g. 50mm; not stored in the capture.",
        ),
    ] = "0m"
    centre: Annotated[
        str, typer.Option("--centre", help="Offset of the object from the axis, X,Y in metres; up to 0.25.")
    ] = "0,0"
    rotation: Annotated[
        float,
        typer.Option("--rotation", min=-1e06, max=1e06, help="Rotation of the object at the start, degrees."),
    ] = 0.0
    wobble: Annotated[float, typer.Option("--wobble", help="Variation of the speed; 0.01 is 1 %.")] = 0.0
    axis_distance: Annotated[float, typer.Option("--axis-distance", help="Radar to axis, metres.")] = 1.0
    snr: Annotated[
        float,
        typer.Option("--snr", help="Peak of the strongest reflector over the noise of one sample, dB."),
    ] = 20.0
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            help="Random seed of the recording and of the object: also where a handle or seam is.",
            min=0,
        ),
    ] = 0

    def spec(self, **changed: Any) -> SceneSpec:
        """The scene of these options, some of them changed. Raises UsageError."""
        from tagid.simulate import SceneSpec

        return SceneSpec(**{**vars(self), "centre": parse_point("--centre", self.centre), **changed})
