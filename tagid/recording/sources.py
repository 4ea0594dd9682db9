"""What an emulated radar sees: scenes and recordings by name."""

from __future__ import annotations

from pathlib import Path

from tagid.errors import UsageError
from tagid.radar.emulation.sources import RecordingSource, ScanSource
from tagid.radar.settings import RadarConfig


def emulated_recording(path: Path, loop: bool) -> RecordingSource:
    """A P440 recording or capture as the radar saw it. Raises the reader's errors."""
    from tagid.storage.importers import read_any

    capture = read_any(path)
    settings = capture.radar.config
    if settings is None:
        raise UsageError(
            f"{path} holds no radar settings, so it cannot be replayed as a radar",
            "Replay a P440 recording (.out, .prd) or a capture made by `tagid scan`.",
        )
    config = RadarConfig.of_stored(settings)
    return RecordingSource(capture.samples, config, capture.radar_time_ms, loop)


def emulated_scene(name: str, options: dict[str, str]) -> ScanSource:
    """A turning scene.

    Options: `seed`, `rpm` (6), `axis_distance` (1.0 m), `snr` (20 dB, per reflector), `cable_delay` (0,
    two-way ps), `centre` (X,Y in metres off the axis), `elevation` (0m), `body` and `reflector` (see
    `tagid.simulate.specification`), and `turned_by`: HOST:PORT of an emulated robot that turns the scene
    instead, which needs rate=1.

    Raises UsageError for an unknown scene or option, or a value that cannot be read.
    """
    from tagid.motion.emulation.truth import TrueAngle
    from tagid.simulate import (
        Acquisition,
        Placement,
        TurningScene,
        parse_body,
        parse_elevation,
        parse_reflector,
        scene_from_name,
        scene_on_body,
    )

    values = {"seed": 0.0, "rpm": 6.0, "axis_distance": 1.0, "snr": 20.0, "cable_delay": 0.0}
    texts = {"turned_by": "", "centre": "0,0", "elevation": "0m", "body": "", "reflector": ""}
    for key, text in options.items():
        if key in texts:
            texts[key] = text
        elif key in values:
            values[key] = _number(name, key, text)
        else:
            known = ", ".join((*values, *texts))
            raise UsageError(f"scene {name}: there is no option {key!r}", f"Use {known}.")
    turner = TrueAngle(texts["turned_by"]).at if texts["turned_by"] else None
    seed = int(values["seed"])
    if not abs(values["cable_delay"]) <= 1e6:
        raise UsageError(f"scene {name}: cable_delay is {values['cable_delay']}", "Give picoseconds.")
    x, comma, y = texts["centre"].partition(",")
    centre = (_number(name, "centre", x), _number(name, "centre", y if comma else "none"))
    acquisition = Acquisition(
        axis_distance_m=values["axis_distance"],
        snr_db=values["snr"],
        placement=Placement(centre, height_m=parse_elevation(texts["elevation"])),
    )
    if texts["body"] or texts["reflector"]:
        body = parse_body(texts["body"] or "none")
        scene = scene_on_body(name, body, parse_reflector(texts["reflector"] or "octahedron"), seed)
    else:
        scene = scene_from_name(name, seed)
    delay_s = values["cable_delay"] * 1e-12
    return TurningScene(scene, values["rpm"], seed, acquisition, delay_s, true_angle=turner)


def _number(scene: str, key: str, text: str) -> float:
    """A number from the text of an option. Raises UsageError."""
    try:
        return float(text)
    except ValueError:
        remedy = "Give X,Y in metres." if key == "centre" else "Give a number."
        raise UsageError(f"scene {scene}: {key} is {text!r}", remedy) from None
