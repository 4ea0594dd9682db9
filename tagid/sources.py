"""What an emulated radar sees: scenes and recordings by name.

The radar package may not know simulation or storage, so whoever opens a radar brings this along.
"""

from __future__ import annotations

from pathlib import Path

from tagid.errors import UsageError
from tagid.radar.settings import RadarConfig
from tagid.radar.sources import RecordingSource, ScanSource


class Sources:
    """`tagid.radar.devices.SourceFactory` over this package's own scenes and readers."""

    def recording(self, path: Path, loop: bool) -> RecordingSource:
        """A P440 recording or capture as the radar saw it. Raises the reader's errors."""
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
        which asks for rate=1.

        Raises UsageError for an unknown scene, option or a value that is no number.
        """
        from tagid.motion.emulator.truth import TrueAngle
        from tagid.simulate import Acquisition, TurningScene, scene_from_name

        values = {"seed": 0.0, "rpm": 6.0, "axis_distance": 1.0, "snr": 20.0, "cable_delay": 0.0}
        turner = TrueAngle(options["turned_by"]).at if "turned_by" in options else None
        for key, text in options.items():
            if key == "turned_by":
                continue
            if key not in values:
                known = ", ".join((*values, "turned_by"))
                raise UsageError(f"scene {name}: there is no option {key!r}", f"Use {known}.")
            try:
                values[key] = float(text)
            except ValueError:
                raise UsageError(f"scene {name}: {key} is {text!r}", "Give a number.") from None
        seed = int(values["seed"])
        acquisition = Acquisition(axis_distance_m=values["axis_distance"], snr_db=values["snr"])
        if not abs(values["cable_delay"]) <= 1e6:
            raise UsageError(f"scene {name}: cable_delay is {values['cable_delay']}", "Give picoseconds.")
        delay_s = values["cable_delay"] * 1e-12
        scene = scene_from_name(name, seed)
        return TurningScene(scene, values["rpm"], seed, acquisition, delay_s, true_angle=turner)
