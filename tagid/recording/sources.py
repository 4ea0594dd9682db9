"""Scenes and recordings for emulated radars, by name."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tagid.config import data_folder
from tagid.errors import StorageError, UsageError
from tagid.files import read_head
from tagid.query import MAX_SEED
from tagid.radar.emulation.sources import RecordingSource
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import RadarOptions

if TYPE_CHECKING:
    from tagid.simulate import TurningScene

MAX_ANTENNA_HEIGHT_M = 10.0
_NUMBERS: Final = {
    "rpm": 6.0, "axis_distance": 1.0, "snr": 20.0, "cable_delay": 0.0, "stop": math.inf, "stop_s": math.inf,
    "rotation": 0.0, "wobble": 0.0, "antenna_height": 0.0, "antenna_separation": 0.0, "budget": 0.0,
}  # fmt: skip
"""Numeric options of a scene, and their values if they are not given."""
_TEXTS: Final = {
    "turned_by": "", "centre": "0,0", "elevation": "0m", "body": "", "reflector": "", "file": "",
    "antenna_height_file": "",
}  # fmt: skip
_NEAREST_M: Final = 1e-3
_MOST: Final = 1e6
"""Largest number of an option; what uses it has narrower limits."""


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


def emulated_scene(name: str, options: dict[str, str]) -> TurningScene:
    """A rotating scene: an enrolled layout, one of a file, or a preset (`tagid.simulate.presets`).

    Options: `seed`, `rpm` (6), `axis_distance` (1.0 m), `antenna_height` (0 m), `antenna_separation` (0 m,
    between a transmitting and a receiving antenna), `snr` (20 dB, per reflector), `cable_delay` (0, two-way
    ps), `centre` (X,Y in metres off the axis), `rotation` (0 degrees), `wobble` (0, relative, of the speed),
    `stop` (turns since the first scan after which the table stops) with `stop_s` (how long it then stands;
    for ever unless given),
    `antenna_height_file` (a text file with the height in metres, read before every scan, so that a program
    can move the emulated antenna), `elevation` (0m), `body` and `reflector` (see
    `tagid.simulate.specification`), `file` (TOML file of layouts), `budget` (1: SNR and range law from the
    radar equation, `tagid.simulate.budget`, for physical reflectors, octahedron:40mm unless given; `snr` is
    then not used), and `turned_by`: HOST:PORT of an emulated robot that turns the scene instead, which needs
    rate=1.

    Raises UsageError for an unknown scene or option, or a value that cannot be read; the errors of
    `named_layouts`.
    """
    from tagid.motion.emulation.truth import TrueAngle
    from tagid.simulate import (
        Acquisition,
        Placement,
        Wobble,
        parse_body,
        parse_elevation,
        parse_reflector,
        scene_from_name,
        scene_on_body,
    )
    from tagid.simulate.presets import is_plain
    from tagid.simulate.source import Stop, TurningScene
    from tagid.tags.enrolling.lookup import named_layouts

    query = RadarOptions(f"scene {name}", dict(options), "Give a number.")
    seed = query.whole("seed", 0, 0, MAX_SEED)
    values = {
        key: query.number(key, default, _NEAREST_M if key == "axis_distance" else -_MOST, _MOST)
        for key, default in _NUMBERS.items()
    }
    texts = {key: query.given.pop(key, default) for key, default in _TEXTS.items()}
    query.remedy = f"Use {', '.join(('seed', *_NUMBERS, *_TEXTS))}."
    query.done()
    query.remedy = "Give X,Y in metres."
    turner = TrueAngle(texts["turned_by"]).at if texts["turned_by"] else None
    x, comma, y = texts["centre"].partition(",")
    centre = (
        query.checked("centre", x, -_MOST, _MOST),
        query.checked("centre", y if comma else "none", -_MOST, _MOST),
    )
    acquisition = Acquisition(
        axis_distance_m=values["axis_distance"],
        antenna_height_m=values["antenna_height"],
        antenna_separation_m=values["antenna_separation"],
        snr_db=values["snr"],
        placement=Placement(centre, math.radians(values["rotation"]), parse_elevation(texts["elevation"])),
        wobble=Wobble(speed=values["wobble"]),
    )
    if values["budget"]:
        texts["reflector"] = texts["reflector"] or "octahedron:40mm"
        noise = _budget_noise(texts["reflector"], values["axis_distance"])
        acquisition = replace(acquisition, noise_std=noise, range_law=True)
    layouts = None
    if not is_plain(name):
        file = Path(texts["file"]) if texts["file"] else None
        layouts = named_layouts(file, data_folder() / "registry.sqlite")
    if texts["body"] or texts["reflector"]:
        body = parse_body(texts["body"] or "none")
        reflector = parse_reflector(texts["reflector"] or "octahedron")
        scene = scene_on_body(name, body, reflector, seed, layouts=layouts)
    else:
        scene = scene_from_name(name, seed, layouts)
    delay_s = values["cable_delay"] * 1e-12
    lift = HeightFile(Path(texts["antenna_height_file"])) if texts["antenna_height_file"] else None
    stop = Stop(values["stop"], values["stop_s"]) if math.isfinite(values["stop"]) else None
    return TurningScene(scene, values["rpm"], seed, acquisition, delay_s, turner, lift, stop)


class HeightFile:
    """Height of an emulated antenna, m, as another program writes it to a text file.

    Calling it returns the current height. A file that cannot be read for a moment leaves the height
    unchanged.

    Args:
        path: the file; it must contain a height when the emulator starts.

    Raises UsageError if it does not.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        read = self._read()
        if read is None:
            raise UsageError(
                f"{path} does not contain the height of the emulated antenna",
                f"Write a number of metres from -{MAX_ANTENNA_HEIGHT_M:g} to {MAX_ANTENNA_HEIGHT_M:g} to it.",
            )
        self._height = read

    def __call__(self) -> float:
        read = self._read()
        if read is not None:
            self._height = read
        return self._height

    def _read(self) -> float | None:
        try:
            height = float(read_head(self._path, 64))
        except (StorageError, ValueError):
            return None
        return height if abs(height) <= MAX_ANTENNA_HEIGHT_M else None


def _budget_noise(reflector: str, axis_distance_m: float) -> float:
    """Standard deviation of a sample at index 11, where a reflector peaks at 1 (on the axis, 4 GHz)."""
    from tagid.simulate.budget import LinkBudget
    from tagid.simulate.scatterers import Octahedron, unit_of
    from tagid.simulate.snr import noise_std_for
    from tagid.simulate.specification import parse_reflector

    unit_m = unit_of(Octahedron(parse_reflector(reflector).size_m))
    return noise_std_for(LinkBudget().snr_db(unit_m, axis_distance_m), 1.0)
