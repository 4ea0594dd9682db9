"""Records and reads with one configuration, which selects the registry, the history and the folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.config import Config, data_folder, load_config, radar_url
from tagid.errors import ConfigError, TagidError, UsageError
from tagid.files import make_folder

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.enrolling.registry import Registry
    from tagid.metadata import ObjectInfo
    from tagid.operate.turn import Answer, ReadingSetup
    from tagid.pipeline.prepared import LoadSettings
    from tagid.pipeline.settings import ImagingSettings
    from tagid.radar.settings import RadarConfig
    from tagid.recording.plan import RecordingPlan
    from tagid.recording.recorder import Watch

LONGEST_S = 86400.0
"""Longest recording, s."""
MOST_SCANS = 65534
"""Largest number of scans in a recording."""
TURN_S = 180.0
"""Time within which a table that turns at 0.35 rpm completes a turn, s."""
NOT_COMMISSIONED = "rig not commissioned: `tagid commission` measures its delay, pulse and axis"


def open_registry() -> Registry:
    """The registry of layouts, bodies and objects of this computer's user."""
    from tagid.enrolling.registry import Registry

    return Registry(data_folder() / "registry.sqlite")


class Workplace:
    """Records and names objects with one configuration, as `tagid scan` and `tagid identify` do.

    The answers are those of the commands. Each answer is a run of the history; those in a `with` block are
    one run together.

    >>> with Workplace({"motion.axis_distance_m": 1.0}) as place:
    ...     place.config["motion.axis_distance_m"]
    1.0

    Args:
        settings: a configuration, or values by name, which precede those of environment and file;
            `tagid config` lists them.
        background: the static background to remove: "mean", "median", "none" or "reference", the stored
            recording of the empty scene.

    Attributes:
        config: the configuration.
        background: as given.

    Raises:
        ConfigError: a setting is unknown or out of range.
        StorageError: the configuration file cannot be read.
        UsageError: unknown background.
    """

    def __init__(self, settings: Config | Mapping[str, Any] | None = None, background: str = "mean") -> None:
        from tagid.pipeline.prepared import BACKGROUNDS

        if background not in BACKGROUNDS:
            raise UsageError(f"`background` is {background!r}", f"Use {', '.join(BACKGROUNDS)}.")
        self.config = settings if isinstance(settings, Config) else load_config(dict(settings or {}))
        self.background = background
        self._entered = False
        self._run: int | None = None

    def __enter__(self) -> Workplace:
        self._entered, self._run = True, None
        return self

    def __exit__(self, *_: object) -> None:
        self._entered = False

    @property
    def registry(self) -> Registry:
        """The registry of layouts, bodies and objects of this computer's user."""
        return open_registry()

    def folder(self) -> Path:
        """The folder of the captures and pictures; created if it is missing. Raises StorageError."""
        folder = Path(self.config["storage.folder"] or ".")
        make_folder(folder)
        return folder

    def imaging(self, focus: bool = True) -> ImagingSettings:
        """The settings of imaging and reading, with or without a search for the axis distance.

        Raises UsageError if the setting `imaging.ats` is malformed.
        """
        from tagid.imaging.ats.settings import AtsSettings, parse_settings
        from tagid.pipeline.settings import ImagingSettings, TagPriors

        config = self.config
        # A reference is subtracted while loading, by `load_capture`.
        background = "none" if self.background == "reference" else self.background
        return ImagingSettings(
            method=config["imaging.method"],
            extent_m=config["imaging.extent_m"],
            pixels=config["imaging.pixels"],
            background=background,  # type: ignore[arg-type]
            focus_m=None if focus else 0.0,
            false_accept=config["tags.false_accept"],
            direction_known=config["tags.direction"] == "known",
            priors=TagPriors(
                centre_sigma_m=config["tags.centre_sigma_m"],
                radius_sigma_m=config["tags.radius_sigma_m"],
            ),
            pulse=config["imaging.pulse"],
            ats=AtsSettings(**parse_settings([config["imaging.ats"]])),
        )

    def loading(self, node: int | None = None, as_recorded: bool = False) -> LoadSettings:
        """The settings of loading a recording.

        Args:
            node: number of the radar to read, if a log holds several.
            as_recorded: whether the capture was recorded with these settings and keeps its angles.

        Raises:
            ConfigError: no reference background is stored.
            StorageError, FileFormatError: the reference background cannot be read.
        """
        from tagid.pipeline.prepared import LoadSettings

        return LoadSettings.of(self.config, self.background, node, as_recorded)

    def setup(self, as_recorded: bool = False) -> ReadingSetup:
        """All that an answer depends on besides the recording, with the registry's contents at this moment.

        Raises:
            ConfigError, StorageError, FileFormatError, UsageError: as `loading` and `imaging`.
            RegistryError: the registry cannot be read.
        """
        from tagid.operate.turn import ReadingSetup

        return ReadingSetup(self.loading(as_recorded=as_recorded), self.imaging(), self.registry.contents())

    def without_profile(self, answer: Answer) -> tuple[str, ...]:
        """That the rig is not commissioned, where an answer of its own radar has no name; else nothing."""
        from tagid.rig import installed_profile

        emulated = self.radar_url().startswith(("emulator://", "replay://"))
        if emulated or answer.status in ("identified", "failed"):
            return ()
        return () if installed_profile(data_folder()) else (NOT_COMMISSIONED,)

    def radar_url(self) -> str:
        """The URL of the configured radar. Raises ConfigError if none is configured."""
        return radar_url(self.config)

    def plan(
        self, scans: int | None = None, max_seconds: float = TURN_S, about: ObjectInfo | None = None
    ) -> RecordingPlan:
        """The plan of a recording, for `tagid.record`.

        Args:
            scans: number of scans; None: until one revolution is complete.
            max_seconds: longest duration, s.
            about: description of the object.

        Raises:
            ConfigError: no radar, no axis distance, or a limit out of range.
        """
        from tagid.metadata import ObjectInfo
        from tagid.recording.plan import RecordingPlan

        if scans is not None and not 1 <= scans <= MOST_SCANS:
            raise ConfigError(f"`scans` is {scans}", f"Give 1 to {MOST_SCANS}.")
        if not 0 < max_seconds <= LONGEST_S:
            raise ConfigError(f"`max_seconds` is {max_seconds}", "Give a positive number of seconds.")
        config = self.config
        return RecordingPlan(
            self._window(),
            config["motion.axis_distance_m"],
            config["motion.antenna_height_m"],
            config["motion.antenna_separation_m"],
            config["radar.cable_delay_ps"],
            scans,
            max_seconds,
            config["motion.url"].public,
            about or ObjectInfo(),
            config["radar.resume_s"],
            renumber=True,
        )

    def _window(self) -> RadarConfig | None:
        """The radar settings to request; None keeps those of a replayed recording."""
        from tagid.radar.settings import RadarConfig
        from tagid.recording.plan import plan_window

        config = self.config
        distance = config["motion.axis_distance_m"]
        if self.radar_url().startswith("replay://"):
            return None
        base = RadarConfig().configured(config)
        if distance is None:
            raise ConfigError(
                "the distance from the radar to the rotation axis is unknown",
                "Measure it to 1 or 2 cm and set `motion.axis_distance_m` to it, or store it with "
                "`tagid config set motion.axis_distance_m METRES`.",
            )
        return plan_window(distance, config["imaging.extent_m"], config["radar.cable_delay_ps"], base)

    def remember(
        self, command: str, items: Sequence[dict[str, Any]], settings: Mapping[str, Any]
    ) -> tuple[str, ...]:
        """Store answer documents (`Answer.to_dict`) of a command in the history, with their settings.

        Returns why they could not be stored; empty if they were. No error, because the answers are valid.
        """
        from tagid.storage.history import FILE_NAME, History

        try:
            history = History(data_folder() / FILE_NAME)
            if self._run is None or not self._entered:
                self._run = history.begin(command, dict(settings))
            history.add(self._run, items)
        except TagidError as error:
            return (f"not stored in the history: {error.message}. {error.remedy}",)
        return ()

    def identify(self, source: Path | str | Capture) -> Answer:
        """Name the object of a recording, as `tagid identify` does, and store the answer in the history.

        The source is a file in any supported format, or a capture in memory. The status of the answer is
        "failed", with the error, if it cannot be read.

        Raises ConfigError, StorageError, FileFormatError, UsageError, RegistryError: as `setup`.
        """
        from tagid.operate.turn import read

        return self._remembered(read(self.setup(), Path(source) if isinstance(source, str) else source))

    def identify_together(self, sources: Iterable[Path | str | Capture]) -> Answer:
        """One joint answer from recordings of one object, as `tagid identify --vote` gives it.

        The sources are files in any supported format, or captures in memory. The answer is stored in the
        history; `alone` holds the answer of each recording.

        Raises:
            DataError, FileFormatError, StorageError: a recording cannot be read.
            ConfigError, UsageError, RegistryError: as `setup`.
        """
        from tagid.operate.turn import read_jointly

        files = [Path(source) if isinstance(source, str) else source for source in sources]
        return self._remembered(read_jointly(self.setup(), files))

    def scan(self, note: str = "", watch: Watch | None = None) -> Answer:
        """Record one revolution, name the object and draw it, as `tagid scan` does.

        The answer is stored in the history; capture and picture are written into the folder.

        Args:
            note: stored in the capture.
            watch: callbacks of the recording.

        Returns:
            The answer, with the name of the capture file; its status is "failed", with the error, if the
            recording cannot be read.

        Raises:
            ConfigError: no radar or no axis distance is configured.
            UsageError: the URL of radar or motion is malformed.
            DeviceError: the radar or the motion failed.
            DataError: no scan arrived.
            StorageError: a file cannot be written.
            RegistryError: the registry cannot be read.
            CaptureInterrupted: the user stopped the recording; the capture is kept.
        """
        from tagid.metadata import ObjectInfo
        from tagid.operate.turn import draw, picture_of, read, record_turn

        setup = self.setup(as_recorded=True)
        plan = self.plan(about=ObjectInfo(note=note or None))
        recorded = record_turn(self, plan, watch=watch)
        answer = read(setup, recorded.capture, recorded.path)
        try:
            draw(answer, picture_of(recorded.path))
        except TagidError as error:
            answer = replace(answer, notes=(*answer.notes, f"no picture: {error.message}"))
        return self._remembered(replace(answer, notes=(*answer.notes, *self.without_profile(answer))))

    def _remembered(self, answer: Answer) -> Answer:
        config = self.config
        motion = config["motion.url"].public
        settings = {"background": self.background, "radar": config["radar.url"], "motion": motion}
        notes = self.remember("python", [answer.to_dict()], settings)
        return replace(answer, notes=(*answer.notes, *notes))
