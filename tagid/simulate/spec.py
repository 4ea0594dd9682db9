"""A scene as `tagid simulate`, `tagid emulate p440`, emulator:// URLs and the Python API request it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from tagid.config import data_folder
from tagid.enrolling.layout_file import named_layouts
from tagid.errors import UsageError
from tagid.motion.emulation.truth import TrueAngle
from tagid.query import MAX_SEED, parse_point
from tagid.radar.urls import RadarOptions
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.budget import LinkBudget
from tagid.simulate.presets import is_plain, scene_from_name, scene_on_body
from tagid.simulate.response_file import ResponseFiles
from tagid.simulate.rig import RigScene, parse_rig
from tagid.simulate.scatterers import Octahedron, unit_of
from tagid.simulate.scene import Scene
from tagid.simulate.snr import noise_std_for
from tagid.simulate.source import HeightFile, Stop, TurningScene
from tagid.simulate.specification import parse_body, parse_elevation, parse_reflector

MAX_UNLIKE_DB: Final = 20.0
_URL_NUMBERS: Final = (
    "rpm", "axis_distance", "snr", "cable_delay", "stop", "stop_s", "rotation", "wobble", "antenna_height",
    "antenna_separation", "budget",
)  # fmt: skip
_URL_TEXTS: Final = ("turned_by", "centre", "elevation", "body", "reflector", "rig")
_URL_FILES: Final = ("file", "antenna_height_file")
_NOT_WITH_A_RESPONSE: Final = (
    "file", "body", "reflector", "unlike", "range_law", "budget", "antenna_height_file",
)  # fmt: skip
_NOT_WITH_A_RIG: Final = (
    "response", "reflector", "unlike", "wobble", "axis_distance", "antenna_height", "antenna_separation",
    "snr", "noise", "range_law", "budget", "turned_by", "stop", "antenna_height_file", "cable_delay",
)  # fmt: skip
_NEAREST_M: Final = 1e-3
_MOST: Final = 1e6
"""Largest number of an option; what uses it has narrower limits."""


@dataclass(frozen=True)
class SceneSpec:
    """A simulated scene and how it is recorded, by the names and in the units of the options.

    `tagid simulate`, `tagid emulate p440` and emulator:// URLs take the same options. Angles are degrees.

    >>> scene, acquisition = SceneSpec("helmet-120", rotation=30, centre=(0.005, 0.0)).build(views=72)

    Attributes:
        scene: an enrolled layout, one of `file`, or a preset: points-N, can, box, corner, empty, untagged.
        file: TOML or JSON file with further layouts.
        response: response file of the object, instead of a scene.
        polarisation: V (default) or H, of the response.
        snr_reference: response to whose peak `snr` refers; None: the object's own.
        snr_reference_body: response that is subtracted from `snr_reference`.
        body, reflector: body and reflectors of the tag, e.g. "can:35mm,handle" and "octahedron:20mm".
        unlike: standard deviation of the reflectors' strengths, 0 to 20 dB.
        seed: random seed of object and room; of an emulated radar, also of wobble and noise.
        elevation: height of the tag above the stated plane, with its unit, e.g. "50mm".
        centre: (x, y) of the object off the axis, m.
        rotation: rotation of the object, degrees.
        wobble: relative variation of the speed; 0.01 is 1 %.
        axis_distance, antenna_height: radar to axis and above the object's plane, m.
        antenna_separation: horizontal distance between transmitting and receiving antenna, m; 0: one antenna.
        snr: ratio of the strongest reflector's peak to the noise of one sample, dB.
        noise: standard deviation of the noise of one sample; replaces `snr`.
        range_law: echo power falls as 1/R^4.
        budget: noise and range law from the radar equation (`tagid.simulate.budget`), for physical
            reflectors, octahedron:40mm unless given.
        rpm: speed of an emulated table, turns per minute.
        turned_by: HOST:PORT of an emulated robot that rotates the object instead, in real time.
        stop: turns since the first scan after which the table stops, and
        stop_s: for how long, s.
        antenna_height_file: text file with the height in metres, read before every scan; replaces
            `antenna_height`.
        cable_delay: two-way delay of the emulated cables, ps.
        rig: profile of a commissioned rig, or realistic?seed=N: it replaces distance, height, pulse, delay,
            noise, speed and wobble (`tagid.simulate.rig`).

    Raises UsageError for options that contradict each other.
    """

    scene: str | None = None
    file: Path | None = None
    response: Path | None = None
    polarisation: str | None = None
    snr_reference: Path | None = None
    snr_reference_body: Path | None = None
    body: str | None = None
    reflector: str | None = None
    unlike: float = 0.0
    seed: int = 0
    elevation: str = "0m"
    centre: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    wobble: float = 0.0
    axis_distance: float = 1.0
    antenna_height: float = 0.0
    antenna_separation: float = 0.0
    snr: float = 20.0
    noise: float | None = None
    range_law: bool = False
    budget: bool = False
    rpm: float = 6.0
    turned_by: str | None = None
    stop: float = math.inf
    stop_s: float = math.inf
    antenna_height_file: Path | None = None
    cable_delay: float = 0.0
    rig: str | None = None

    def __post_init__(self) -> None:
        if (self.scene is None) == (self.response is None):
            raise UsageError(
                "give either a scene or `response=FILE`", "`tagid simulate --help` has examples."
            )
        if self.response is not None:
            why = "a response file contains the complete object"
            check_unchanged(self, _NOT_WITH_A_RESPONSE, "`response`", why)
        elif self.polarisation or self.snr_reference or self.snr_reference_body:
            raise UsageError(
                "`polarisation`, `snr_reference` and `snr_reference_body` need `response`",
                "Add `response=FILE`.",
            )
        if self.rig is not None:
            check_unchanged(self, _NOT_WITH_A_RIG, "`rig`", "the rig determines how it records")
        if not 0 <= self.unlike <= MAX_UNLIKE_DB:
            raise UsageError(f"`unlike` is {self.unlike:g} dB", f"Give 0 to {MAX_UNLIKE_DB:g} dB.")
        if self.unlike and not (self.body or self.reflector):
            raise UsageError("`unlike` needs physical reflectors", "Add `reflector=octahedron:20mm`.")

    @classmethod
    def from_url(cls, scene: str, options: Mapping[str, str]) -> SceneSpec:
        """The scene of an emulator:// URL, from its name and its options.

        Raises UsageError for an option that is unknown, or whose value cannot be read.
        """
        query = RadarOptions(f"scene {scene}", dict(options), "Give a number.")
        values: dict[str, Any] = {"seed": query.whole("seed", 0, 0, MAX_SEED)}
        for key in _URL_NUMBERS:
            if key in query.given:
                least = _NEAREST_M if key == "axis_distance" else -_MOST
                values[key] = query.number(key, 0.0, least, _MOST)
        values |= {key: query.given.pop(key) for key in _URL_TEXTS if key in query.given}
        values |= {key: Path(text) for key in _URL_FILES if (text := query.text(key))}
        query.remedy = f"Use {', '.join(('seed', *_URL_NUMBERS, *_URL_TEXTS, *_URL_FILES))}."
        query.done()
        if "centre" in values:
            values["centre"] = parse_point("centre", values["centre"])
        return cls(scene, **{**values, "budget": bool(values.get("budget"))})

    def build(self, **recording: Any) -> tuple[Scene, Acquisition]:
        """The scene, and the acquisition that the options request.

        Args:
            recording: further fields of the `Acquisition`, e.g. views=72.

        Raises:
            UsageError: the scene is unknown, or a value is out of its range.
            StorageError, FileFormatError, RegistryError: a file, or the registry, cannot be read.
        """
        if self.rig is not None:
            rig = parse_rig(self.rig)
            given = Placement(self.centre, math.radians(self.rotation), parse_elevation(self.elevation))
            known = named_layouts(self.file, data_folder() / "registry.sqlite")
            scene = rig.scene(str(self.scene), known, parse_body(self.body or "none"))
            given_values = {key: value for key, value in recording.items() if value is not None}
            return scene, replace(rig.acquisition(given), **{"period_s": rig.period_s, **given_values})
        on_reflector = self.reflector or ("octahedron:40mm" if self.budget else None)
        noise, snr = self.noise, None if self.noise is not None else self.snr
        if self.budget:
            # At integration index 11, where a reflector peaks at 1 (on the axis, 4 GHz).
            unit_m = unit_of(Octahedron(parse_reflector(str(on_reflector)).size_m))
            noise = noise_std_for(LinkBudget().snr_db(unit_m, self.axis_distance), 1.0)
        acquisition = Acquisition(
            axis_distance_m=self.axis_distance,
            antenna_height_m=self.antenna_height,
            antenna_separation_m=self.antenna_separation,
            snr_db=snr,
            noise_std=noise,
            placement=Placement(self.centre, math.radians(self.rotation), parse_elevation(self.elevation)),
            wobble=Wobble(speed=self.wobble),
            range_law=self.range_law or self.budget,
        )
        acquisition = replace(acquisition, **recording)
        if self.response is not None:
            letter = (self.polarisation or "V").upper()
            files = ResponseFiles(self.response, letter, self.snr_reference, self.snr_reference_body)
            return files.scene(acquisition, self.seed), acquisition
        name = str(self.scene)
        layouts = None if is_plain(name) else named_layouts(self.file, data_folder() / "registry.sqlite")
        if not (self.body or on_reflector):
            return scene_from_name(name, self.seed, layouts), acquisition
        body, reflector = parse_body(self.body or "none"), parse_reflector(on_reflector or "octahedron")
        return scene_on_body(name, body, reflector, self.seed, self.unlike, layouts), acquisition


def turning_scene(spec: SceneSpec) -> TurningScene:
    """The scene on an emulated turntable, for the radar emulator. Raises the errors of `SceneSpec.build`."""
    scene, acquisition = spec.build()
    if spec.rig is not None:
        return RigScene(scene, parse_rig(spec.rig), acquisition.placement, spec.seed)
    turner = None if spec.turned_by is None else TrueAngle(spec.turned_by).at
    lift = HeightFile(spec.antenna_height_file) if spec.antenna_height_file else None
    stop = Stop(spec.stop, spec.stop_s) if math.isfinite(spec.stop) else None
    delay_s = spec.cable_delay * 1e-12
    return TurningScene(scene, spec.rpm, spec.seed, acquisition, delay_s, turner, lift, stop)


def check_unchanged(options: Any, names: Collection[str], instead: str, why: str) -> None:
    """Refuse options of a scene, named as the fields of a dataclass, that have no effect beside the option
    `instead`.

    Raises UsageError, which names those that differ from their defaults, and says why.
    """
    given = [
        f"`{item.name}`"
        for item in fields(options)
        if item.name in names and getattr(options, item.name) != item.default
    ]
    if given:
        listed = ", ".join(given[:-1]) + " and " * (len(given) > 1) + given[-1]
        raise UsageError(
            f"{listed} cannot be combined with {instead}",
            f"Omit {'them' if len(given) > 1 else 'it'}: {why}.",
        )
