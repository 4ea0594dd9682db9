"""Options that several commands take, declared once, and types of options that take a number in a unit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from tagid import secret
from tagid.errors import UsageError
from tagid.query import UNITS, parse_point, quantity

if TYPE_CHECKING:
    from tagid.simulate import SceneSpec


def _in(unit: str) -> Callable[[str | float], float]:
    """The parser of an option whose value is in a unit; the help shows it as a float."""

    def number(text: str | float) -> float:
        try:
            return quantity(text, unit) if isinstance(text, str) else text
        except ValueError:
            raise typer.BadParameter(
                f"{str(text)[:40]!r} is not a number, in {unit} or with its unit: {', '.join(UNITS[unit])}."
            ) from None

    number.__name__ = "float"
    return number


METRES = _in("m")
MILLIMETRES = _in("mm")
SECONDS = _in("s")
PICOSECONDS = _in("ps")
NANOSECONDS = _in("ns")


Captures = Annotated[list[Path], typer.Argument(help="Capture, NPZ, .out/.prd, CSV or journal.")]
CaptureFile = Annotated[Path, typer.Argument(help="Capture, NPZ, .out/.prd, CSV or journal.")]
RadarUrl = Annotated[
    str | None, typer.Option("--radar", help="The radar: udp://HOST, serial:///dev/ttyACM0, replay://FILE.")
]
MotionUrl = Annotated[
    secret.MotionUrl | None,
    typer.Option(
        "--motion",
        help="Device that rotates the object, e.g. free?rpm=2.",
        parser=secret.MotionUrl,
        metavar="TEXT",
    ),
]
AxisDistance = Annotated[
    float | None, typer.Option("--axis-distance", parser=METRES, help="Radar to rotation axis, metres.")
]
AntennaHeight = Annotated[
    float | None,
    typer.Option("--antenna-height", parser=METRES, help="Antenna above the reflectors' plane, metres."),
]
AntennaSeparation = Annotated[
    float | None,
    typer.Option(
        "--antenna-separation",
        parser=METRES,
        help="Horizontal distance between transmitting and receiving antenna, metres; 0: one antenna.",
        show_default=False,
    ),
]
CableDelay = Annotated[
    float | None,
    typer.Option("--cable-delay", parser=PICOSECONDS, help="Cable and antenna delay, two-way picoseconds."),
]
Node = Annotated[
    int | None,
    typer.Option("--node", min=0, max=4294967295, help="Node id of the radar to read from a log of several."),
]
Method = Annotated[
    str | None,
    typer.Option("--method", help="bp, bp-raw, range-doppler, polar, sparse, omp, ats or auto (ats)."),
]
Preview = Annotated[bool, typer.Option("--preview", help="Draw the image in the terminal.")]
PngFile = Annotated[Path | None, typer.Option("--png", help="Write the image as a picture.")]
Body = Annotated[
    str | None,
    typer.Option(
        "--body", help="Body that carries the tag: can:35mm, cup:40mm,handle, helmet, box:120mm or none."
    ),
]
Reflector = Annotated[str | None, typer.Option("--reflector", help="Reflectors of the tag: octahedron:20mm.")]
Seed = Annotated[int, typer.Option("--seed", help="Random seed.", min=0)]
LayoutFile = Annotated[
    Path | None, typer.Option("--file", help="File with further layouts, e.g. from layouts design --out.")
]


@dataclass(frozen=True)
class SetupOptions:
    """How the object stood and turned before the radar, where a command line says it."""

    motion: MotionUrl = None
    axis_distance: AxisDistance = None
    antenna_height: AntennaHeight = None
    antenna_separation: AntennaSeparation = None

    def settings(self) -> dict[str, Any]:
        """The options as settings, by their configuration names."""
        return {
            "motion.url": self.motion,
            "motion.axis_distance_m": self.axis_distance,
            "motion.antenna_height_m": self.antenna_height,
            "motion.antenna_separation_m": self.antenna_separation,
        }


@dataclass(frozen=True)
class RecordedOptions(SetupOptions):
    """The same of a recording, and the background in it."""

    background: Annotated[
        str, typer.Option(help="Static background to remove: mean, median, reference, none.")
    ] = "mean"


def demo_settings(scene: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a demo, by their configuration names: a P440 that is emulated in this process in real time.

    Args:
        scene: of the object.
        given: settings of the command line, None for none: a demo has no others.

    Raises UsageError for an unknown scene, and for settings that the demo would overrule.
    """
    from tagid.recording.radars import emulated_object

    # Objects are never exactly on the axis: object and body are 6 mm off.
    url = f"emulator://{quote(scene)}?rpm=6&centre=0.005,-0.003&rate=1"
    emulated_object(url)
    # A commissioned rig is another one: what it measured is not of this radar.
    measured = {
        "radar.cable_delay_ps": 0.0,
        "motion.antenna_height_m": 0.0,
        "motion.antenna_separation_m": 0.0,
    }
    settings = {"radar.url": url, "motion.url": "free?rpm=6", "motion.axis_distance_m": 1.0, **measured}
    if any(given.get(name) is not None for name in settings):
        raise UsageError(
            "--demo brings its own radar, turntable and distances",
            "Omit --demo, or --radar, --cable-delay, --motion and the distances.",
        )
    return settings


@dataclass(frozen=True)
class SceneOptions:
    """The options that both commands share, by the names of `SceneSpec`."""

    file: LayoutFile = None
    response: Annotated[
        Path | None, typer.Option(help="Response file of the object, instead of a scene (docs/responses.md).")
    ] = None
    polarisation: Annotated[str | None, typer.Option(help="With --response: V (default) or H.")] = None
    snr_reference: Annotated[
        Path | None, typer.Option(help="With --response: response whose peak --snr refers to.")
    ] = None
    snr_reference_body: Annotated[
        Path | None, typer.Option(help="Response subtracted from --snr-reference.")
    ] = None
    body: Body = None
    reflector: Reflector = None
    elevation: Annotated[
        str,
        typer.Option(help="Height of the tag above the stated plane, e.g. 50mm; not stored in the capture."),
    ] = "0m"
    centre: Annotated[
        str, typer.Option(help="Offset of the object from the axis, X,Y in metres; up to 0.25.")
    ] = "0,0"
    rotation: Annotated[
        float, typer.Option(min=-1e06, max=1e06, help="Rotation of the object at the start, degrees.")
    ] = 0.0
    wobble: Annotated[float, typer.Option(help="Variation of the speed; 0.01 is 1 %.")] = 0.0
    axis_distance: Annotated[float, typer.Option(parser=METRES, help="Radar to axis, metres.")] = 1.0
    snr: Annotated[
        float, typer.Option(help="Peak of the strongest reflector over the noise of one sample, dB.")
    ] = 20.0
    seed: Annotated[
        int,
        typer.Option(
            help="Random seed of the recording and of the object: also where a handle or seam is.", min=0
        ),
    ] = 0
    rig: Annotated[
        str | None,
        typer.Option(
            help="Profile of a commissioned rig, or realistic?seed=N: sets how the scene is recorded."
        ),
    ] = None

    def spec(self, **changed: Any) -> SceneSpec:
        """The scene of these options, some of them changed. Raises UsageError."""
        from tagid.simulate import SceneSpec

        return SceneSpec(**{**vars(self), "centre": parse_point("--centre", self.centre), **changed})


def parse_bind(bind: str, example: str) -> tuple[str, int]:
    """Host and port of --bind. Raises UsageError, with an example of what it takes."""
    host, _, port = bind.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise UsageError(f"--bind is {bind!r}", f"Give HOST:PORT, e.g. {example}.")
    return host.removeprefix("[").removesuffix("]"), int(port)
