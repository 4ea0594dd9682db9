"""Stored settings, each with the source of its value.

The command line overrides the environment, which overrides the file, which overrides the profile of the
commissioned rig, which overrides the defaults.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal

from tagid.constants import RIG_FILE
from tagid.counting import meant
from tagid.errors import ConfigError, FileFormatError, TagidError, displayable
from tagid.query import UNITS, quantity
from tagid.secret import MotionUrl, Secret

Source = Literal["command line", "environment", "file", "rig profile", "default"]


KIT_ADDRESSES = "192.168.1.100,192.168.1.101,192.168.1.102,192.168.1.103"
"""Addresses of the units of a P440 kit at delivery (P440 MRM documents)."""

MAX_BYTES = 1 << 20
"""Largest configuration file, bytes; all settings together take some kilobytes."""

METHODS = ("auto", "bp", "bp-raw", "range-doppler", "polar", "sparse", "omp", "ats")
"""Names in `tagid.pipeline.reconstruct`, repeated here so that help does not import numpy."""


IMPLAUSIBLE_AXIS_M = 20.0
"""Axis distances above this were probably given in centimetres or millimetres: at 20 m an echo is 52 dB
weaker than at 1 m, which no P440 receives from a tag."""


@dataclass(frozen=True)
class Setting:
    """One setting's definition: dotted name, type, default, bounds and help line."""

    name: str
    kind: type[str] | type[float] | type[int] | type[Secret]
    default: str | float | int | Secret | None
    help: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def variable(self) -> str:
        """Name of its environment variable."""
        return "TAGID_" + self.name.upper().replace(".", "_")

    @property
    def unit(self) -> str:
        """Its unit, with which its name ends, e.g. "m"; "" without one."""
        return self.name.rpartition("_")[2] if self.kind is float else ""


SETTINGS: tuple[Setting, ...] = (
    Setting("radar.url", str, None, "the radar, e.g. udp://192.168.1.100"),
    Setting(
        "radar.addresses",
        str,
        KIT_ADDRESSES,
        "addresses that `radar find` probes: HOST[:PORT], comma-separated",
    ),
    Setting("radar.integration", int, 11, "pulse integration index, 6 to 15 (2^n pulses per sample)", 6, 15),
    Setting("radar.gain", int, 63, "transmit gain, 0 to 63", 0, 63),
    Setting("radar.antenna_mode", int, 2, "0 A/A, 1 B/B, 2 TxA-RxB, 3 TxB-RxA", 0, 3),
    Setting("radar.cable_delay_ps", float, 0.0, "cable and antenna delay, two-way, ps", -1e6, 1e6),
    Setting(
        "radar.cable_delay_sigma_ps", float, None, "its standard deviation, ps (radar calibrate)", 0, 1e5
    ),
    Setting("radar.background", str, None, "capture of the empty scene (radar calibrate)"),
    Setting(
        "radar.timeout_s", float, 2.0, "time without data after which the radar counts as lost, s", 0.05, 60
    ),
    Setting("radar.resume_s", float, 20.0, "longest time to wait for a lost radar, s", 0, 3600),
    Setting("motion.url", MotionUrl, MotionUrl("free"), "device that rotates the object, e.g. free?rpm=2"),
    Setting("motion.passkey", Secret, None, "six-digit pass-key of the Bluetooth bridge"),
    Setting("motion.axis_distance_m", float, None, "radar to rotation axis, m", 1e-3, IMPLAUSIBLE_AXIS_M),
    Setting("motion.antenna_height_m", float, 0.0, "antenna above the object's plane, m", -10, 10),
    Setting(
        "motion.antenna_heights",
        str,
        "",
        "heights of the antenna at which every object is scanned, m, comma-separated; empty: one",
    ),
    Setting(
        "motion.antenna_separation_m", float, 0.0, "distance between transmit and receive antenna, m", 0, 10
    ),
    Setting("imaging.method", str, "auto", "bp, sparse, ats, auto and more", choices=METHODS),
    Setting("imaging.extent_m", float, 0.5, "width of the image, m", 1e-3, 1e4),
    Setting("imaging.ats", str, "", "settings of ats, e.g. robust=3,calibrate=axis+wobble"),
    Setting(
        "imaging.pulse",
        str,
        "auto",
        "auto (the capture's or nominal), nominal, or estimate (from the scans)",
        choices=("auto", "nominal", "estimate"),
    ),
    Setting("imaging.pixels", int, 128, "pixels per side", 16, 1024),
    Setting(
        "tags.false_accept", float, 5e-3, "probability of naming an object without an enrolled tag", 1e-9, 0.5
    ),
    Setting(
        "tags.centre_sigma_m",
        float,
        6e-3,
        "offset of an object from the axis: standard deviation per coordinate, m",
        5e-4,
        0.03,
    ),
    Setting(
        "tags.radius_sigma_m",
        float,
        1.5e-3,
        "distance of reflectors from the centre, as mounted: standard deviation, m",
        5e-4,
        0.05,
    ),
    Setting(
        "tags.direction",
        str,
        "known",
        "of the turn",
        choices=("known", "unknown"),
    ),
    Setting(
        "station.until_sure",
        str,
        "no",
        "whether a scan of the station ends as soon as the answer is certain",
        choices=("no", "yes"),
    ),
    Setting("storage.folder", str, None, "where captures are written (default: current folder)"),
)
"""All settings."""

_BY_NAME = {setting.name: setting for setting in SETTINGS}


@dataclass(frozen=True)
class ConfigValue:
    """The value of a setting, of its type, and where it comes from."""

    value: Any
    source: Source


@dataclass(frozen=True)
class Config:
    """Values of all settings; `config["radar.url"]` is a value.

    Attributes:
        values: value and source by the setting's name.
        path: the configuration file, which need not exist.
    """

    values: Mapping[str, ConfigValue]
    path: Path

    def __getitem__(self, name: str) -> Any:
        return self.values[name].value


def config_path() -> Path:
    """The configuration file: TAGID_CONFIG, or the user's configuration folder."""
    if os.environ.get("TAGID_CONFIG"):
        return Path(os.environ["TAGID_CONFIG"])
    import platformdirs

    return Path(platformdirs.user_config_dir("tagid")) / "config.toml"


def data_folder() -> Path:
    """Folder of the registry: TAGID_DATA, or the user's data folder."""
    if os.environ.get("TAGID_DATA"):
        return Path(os.environ["TAGID_DATA"])
    import platformdirs

    return Path(platformdirs.user_data_dir("tagid"))


def setting_named(name: str, where: str = "") -> Setting:
    """The setting of a dotted name. Raises ConfigError with where an unknown one stands, "FILE: " or ""."""
    if name not in _BY_NAME:
        raise ConfigError(
            f"{where}unknown setting {name!r}",
            f"{meant(name, _BY_NAME)}`tagid config` lists all settings.",
        )
    return _BY_NAME[name]


def parse_value(name: str, raw: Any, where: str = "") -> Any:
    """Check and convert one value. Raises ConfigError naming the setting, where it stands, and the bounds."""
    setting = setting_named(name, where)
    if setting.kind not in (int, float) and isinstance(raw, list):
        raw = ",".join(map(str, raw))  # a TOML list, for which the command line has commas
    try:
        in_text = setting.kind is float and isinstance(raw, str)
        value: Any = quantity(raw, setting.unit) if in_text else setting.kind(raw)
        if setting.kind is int and float(raw) != value:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        kind = "a whole number" if setting.kind is int else "a number"
        if setting.unit in UNITS:
            kind += f", in {setting.unit} or with its unit: {', '.join(UNITS[setting.unit])}"
        raise ConfigError(f"{where}{name} is {raw!r:.60}, not a number", _another(setting, kind)) from None
    if name == "motion.axis_distance_m" and IMPLAUSIBLE_AXIS_M <= value < inf:
        # Of the two units the one that gives the more usual distance.
        unit, parts = ("mm", 1000) if value > 320 else ("cm", 100)
        raise ConfigError(
            f"{where}{name} is {value:g}. {value:g} m? Give metres",
            f"e.g. {value / parts:g} for {value:g} {unit}; a turntable is usually 1 m from the antennas.",
        )
    if setting.low is not None and setting.high is not None and not setting.low <= value <= setting.high:
        raise ConfigError(
            f"{where}{name} is {value}, expected {setting.low:g} to {setting.high:g}",
            _another(setting, "a value in this range"),
        )
    if setting.choices and value not in setting.choices:
        raise ConfigError(
            f"{where}{name} is {value!r}, expected one of {', '.join(setting.choices)}",
            _another(setting, "one of these"),
        )
    return value


def _another(setting: Setting, what: str) -> str:
    """What to do about a value that cannot be."""
    return f"Give {what} ({setting.help})."


@contextmanager
def _remarked(tolerant: bool) -> Iterator[None]:
    """Log the error of a setting that cannot be used, instead of raising it, if `tolerant`."""
    try:
        yield
    except TagidError as error:
        if not tolerant:
            raise
        logging.getLogger("tagid").warning("%s: ignored", error.message)


def read_file(path: Path, tolerant: bool = False) -> dict[str, Any]:
    """Settings of the file by dotted name; empty if there is no file. Raises ConfigError, StorageError."""
    from tagid import files

    tables: dict[str, Any] = {}
    with _remarked(tolerant):
        try:
            tables = files.read_toml(path, MAX_BYTES, missing_ok=True)
        except FileFormatError as error:
            raise ConfigError(error.message, "Repair or delete it.") from None
    settings: dict[str, Any] = {}
    for section, table in tables.items():
        if not isinstance(table, dict):
            with _remarked(tolerant):
                raise ConfigError(
                    f"{path}: {section!r} is outside a section", "`tagid config` lists all settings."
                )
            continue
        for key, raw in table.items():
            with _remarked(tolerant):
                settings[f"{section}.{key}"] = parse_value(f"{section}.{key}", raw, f"{path}: ")
    return settings


def load_config(overrides: Mapping[str, Any] | None = None, tolerant: bool = False) -> Config:
    """Resolve every setting.

    Args:
        overrides: values of the command line or of a program by name, None meaning not given.
        tolerant: ignore, with a warning in the log, what cannot be used in the file and the environment: for
            a stop, which no configuration may prevent.

    Raises:
        ConfigError: a setting is unknown or out of range, or the profile of the rig is damaged.
        StorageError: a file cannot be read.
    """
    path = config_path()
    from_file = read_file(path, tolerant)
    measured: dict[str, float] = {}
    with _remarked(tolerant):
        measured = _measured()
    values: dict[str, ConfigValue] = {}
    given = {name: parse_value(name, raw) for name, raw in (overrides or {}).items() if raw is not None}
    for setting in SETTINGS:
        if setting.name in given:
            values[setting.name] = ConfigValue(given[setting.name], "command line")
            continue
        values[setting.name] = ConfigValue(setting.default, "default")
        if setting.name in measured:
            values[setting.name] = ConfigValue(measured[setting.name], "rig profile")
        if setting.name in from_file:
            values[setting.name] = ConfigValue(from_file[setting.name], "file")
        if raw := os.environ.get(setting.variable):
            with _remarked(tolerant):
                values[setting.name] = ConfigValue(
                    parse_value(setting.name, raw, f"{setting.variable}: "), "environment"
                )
    return Config(values, path)


def _measured() -> dict[str, float]:
    """Settings from the profile of the commissioned rig; empty without one."""
    folder = data_folder()
    if not (folder / RIG_FILE).exists():
        return {}
    from tagid.rig import installed_profile

    profile = installed_profile(folder)
    return {} if profile is None else profile.settings()


def radar_url(config: Config) -> str:
    """URL of the configured radar. Raises ConfigError if there is none."""
    if not config["radar.url"]:
        raise ConfigError(
            "no radar is configured",
            "Set `radar.url` to udp://192.168.1.100 or serial:///dev/ttyACM0, or store it with "
            "`tagid config set radar.url URL`. `tagid radar find` looks for radars, and "
            "`tagid scan --demo` shows a scan without one.",
        )
    return str(config["radar.url"])


def change_settings(changes: Mapping[str, Any | None]) -> Path:
    """Set several settings in the file at once, removing those that are None; returns the file's path.

    Raises:
        ConfigError: a setting is unknown or out of range; the file is then unchanged.
        StorageError, DiskFullError: the file cannot be written; it is then unchanged.
    """
    path = config_path()
    known = {setting.name for setting in SETTINGS}
    settings = read_file(path)
    for name, raw in changes.items():
        if raw is None and name in known:
            settings.pop(name, None)
        else:
            settings[name] = parse_value(name, raw)
    _write(path, settings)
    return path


def _write(path: Path, settings: Mapping[str, Any]) -> None:
    import tomli_w

    from tagid import files

    tables: dict[str, dict[str, Any]] = {}
    for name, value in settings.items():
        if isinstance(value, str) and displayable(value) != value:
            raise ConfigError(f"{name} is {value!r}, not text in UTF-8", "Choose another name.")
    for name, value in sorted(settings.items()):
        section, key = name.split(".", 1)
        tables.setdefault(section, {})[key] = value.reveal() if isinstance(value, Secret) else value
    files.make_folder(path.parent)
    # It may contain a bridge's pass-key, which only its owner may read. The user may keep it behind a link.
    files.write_bytes(files.resolved(path), tomli_w.dumps(tables).encode(), private=True)
