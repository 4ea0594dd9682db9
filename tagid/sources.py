"""What an emulated radar sees: scenes, responses and recordings by name.

The radar package imports neither simulation nor storage; the caller that opens a radar passes this in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.errors import UsageError
from tagid.radar.settings import RadarConfig
from tagid.radar.sources import RecordingSource, ScanSource

if TYPE_CHECKING:
    from tagid.simulate import Acquisition, Placement, Scene


@dataclass(frozen=True)
class ResponseFiles:
    """An object given by its response file, and what the SNR of its recordings refers to.

    Attributes:
        response: of the object.
        polarisation: "V" or "H".
        reference: response whose strongest echo is the SNR's signal; the object's own where it is None.
        reference_body: response that is subtracted from the reference: tagged object minus its body.
    """

    response: Path
    polarisation: str = "V"
    reference: Path | None = None
    reference_body: Path | None = None

    def scene(self, acquisition: Acquisition, seed: int = 0) -> Scene:
        """The object in a room drawn from the seed; the room is as strong as the object or its reference.

        Raises the reader's errors, and UsageError where the response does not cover the acquisition.
        """
        import numpy as np

        from tagid.simulate.presets import room_clutter
        from tagid.simulate.response_file import read_response
        from tagid.simulate.response_scene import ResponseBody, peak_echo, response_scene
        from tagid.simulate.scene import StaticReturns

        if self.reference_body is not None and self.reference is None:
            raise UsageError("a reference body is given without a reference", "Add --snr-reference FILE.")
        response = read_response(self.response)
        reference = None if self.reference is None else read_response(self.reference)
        if reference is not None and self.reference_body is not None:
            reference = reference.without(read_response(self.reference_body))
        bare = response_scene(response, acquisition, self.polarisation, reference)
        strength = max(
            (peak_echo(b, acquisition) for b in bare.object if isinstance(b, ResponseBody)), default=1
        )
        room = room_clutter(np.random.default_rng(seed))
        room = StaticReturns(room.ranges_m, room.amplitudes * max(strength, 1.0))
        return response_scene(response, acquisition, self.polarisation, reference, room)


class Sources:
    """`tagid.radar.devices.SourceFactory` over this package's own scenes and readers."""

    def recording(self, path: Path, loop: bool) -> RecordingSource:
        """A P440 recording or capture, replayed as the radar sent it. Raises the reader's errors."""
        from tagid.storage.importers import read_any

        capture = read_any(path)
        settings = capture.radar.get("config")
        if not isinstance(settings, dict):
            raise UsageError(
                f"{path} holds no radar settings, so it cannot be replayed as a radar",
                "Replay a P440 recording (.out, .prd) or a capture made by `tagid scan`.",
            )
        known = RadarConfig.__dataclass_fields__
        config = RadarConfig(**{key: value for key, value in settings.items() if key in known})
        return RecordingSource(capture.samples, config, capture.radar_time_ms, loop)

    def scene(self, name: str, options: dict[str, str]) -> ScanSource:
        """A turning scene; options `seed`, `rpm` (6), `axis_distance` (1.0 m), `snr` (20 dB),
        `cable_delay` (0, two-way ps), and `turned_by`: HOST:PORT of an emulated robot that turns it instead,
        which needs rate=1.

        Raises UsageError for an unknown scene, option or a value that is not a number.
        """
        from tagid.simulate import scene_from_name

        return _turning(f"scene {name}", lambda _, seed: scene_from_name(name, seed), options)

    def response(
        self, files: ResponseFiles, options: dict[str, str], placement: Placement | None = None
    ) -> ScanSource:
        """A turning object given by its response; options as for `scene`.

        Raises the reader's errors, and UsageError for a wrong option or a distance that the response lacks.
        """
        return _turning(f"response {files.response}", files.scene, options, placement)


def _turning(
    what: str,
    scene_of: Callable[[Acquisition, int], Scene],
    options: dict[str, str],
    placement: Placement | None = None,
) -> ScanSource:
    """The source of a scene on an emulated turntable."""
    from tagid.motion.emulator.truth import TrueAngle
    from tagid.simulate import Acquisition, Placement, TurningScene

    values = {"seed": 0.0, "rpm": 6.0, "axis_distance": 1.0, "snr": 20.0, "cable_delay": 0.0}
    turner = TrueAngle(options["turned_by"]).at if "turned_by" in options else None
    for key, text in options.items():
        if key == "turned_by":
            continue
        if key not in values:
            known = ", ".join((*values, "turned_by"))
            raise UsageError(f"{what}: there is no option {key!r}", f"Use {known}.")
        try:
            values[key] = float(text)
        except ValueError:
            raise UsageError(f"{what}: {key} is {text!r}", "Give a number.") from None
    if not abs(values["cable_delay"]) <= 1e6:
        raise UsageError(f"{what}: cable_delay is {values['cable_delay']}", "Give picoseconds.")
    seed = int(values["seed"])
    acquisition = Acquisition(
        axis_distance_m=values["axis_distance"],
        snr_db=values["snr"],
        placement=Placement() if placement is None else placement,
    )
    scene = scene_of(acquisition, seed)
    delay_s = values["cable_delay"] * 1e-12
    return TurningScene(scene, values["rpm"], seed, acquisition, delay_s, true_angle=turner)
