"""Checks whether `tagid scan` can work on this computer; each finding has one remedy."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Literal

from tagid._version import __version__
from tagid.config import Config, data_folder
from tagid.errors import FileFormatError, StorageError, TagidError
from tagid.files import read_bytes

Level = Literal["ok", "warning", "problem"]
_LOW_DISK_BYTES = 500 * 2**20
_PACKAGES = ("numpy", "h5py", "typer", "rich", "pillow", "pyserial")
_EXTRA = "scipy"
_MAX_RULE = 1 << 16
"""Of the extra `science`: MATLAB files, and the cross-section of a reflector."""


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        topic: subject of the check.
        level: "ok", "warning" (not essential) or "problem".
        text: the finding.
        remedy: what to do; empty if there is no problem.
        answers: whether the device of this check answers; None if the check is of no device.
    """

    topic: str
    level: Level
    text: str
    remedy: str = ""
    answers: bool | None = None


def examine(config: Config, needs_radar: bool = False) -> list[Finding]:
    """Check software, disk, registry, serial ports and the configured radar.

    With `needs_radar` it is a problem, not a warning, if none is configured.
    """
    radar, serial = _radar(config, needs_radar)
    return [
        *_versions(),
        _engines(),
        _disk(Path(config["storage.folder"] or ".")),
        _registry(),
        _ports(),
        *_system(),
        _axis(config),
        _rig(config, serial),
        radar,
    ]


def _versions() -> list[Finding]:
    names = [*_PACKAGES, *([_EXTRA] if importlib.util.find_spec(_EXTRA) is not None else [])]
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    if _EXTRA not in names:
        versions += f"; without {_EXTRA}: no MATLAB files"
    return [
        Finding("tagid", "ok", f"{__version__} on Python {platform.python_version()}, {platform.system()}"),
        Finding("packages", "ok", versions),
    ]


def _engines() -> Finding:
    from tagid.loops import LOOPS, unusable
    from tagid.models_store import check_all

    engines = [n for n in ("onnxruntime", "torch") if importlib.util.find_spec(n) is not None]
    ats = " and ".join(f"{name} {metadata.version(name)}" for name in engines) or "nothing"
    what = f"bp, sparse, and ats on {ats}"
    try:
        check_all()
    except TagidError as error:
        return Finding("imaging", "problem", error.message, error.remedy)
    slow = unusable()
    if slow:
        few = ", ".join(name.rpartition(".")[2].lstrip("_") for name in slow)
        how = "no compiled loops" if len(slow) == len(LOOPS) else f"compiled loops missing or outdated: {few}"
        remedy = "Install a C compiler, then reinstall tagid; it affects speed only."
        return Finding("imaging", "warning", f"{what}; {how}, up to ten times slower", remedy)
    return Finding("imaging", "ok", f"{what}, compiled loops")


def _disk(folder: Path) -> Finding:
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not os.access(place, os.W_OK):
        return Finding("disk", "problem", f"{place} is not writable", "Set storage.folder to another folder.")
    free = shutil.disk_usage(place).free
    text = f"{free / 2**30:.1f} GiB free for captures in {folder.resolve()}"
    if free < _LOW_DISK_BYTES:
        return Finding("disk", "problem", text, "Free some space; a scan takes up to 50 MB.")
    return Finding("disk", "ok", text)


def _registry() -> Finding:
    from tagid.enrolling.registry import Registry

    path = data_folder() / "registry.sqlite"
    try:
        registry = Registry(path)
        count = len(registry.layouts())
    except TagidError as error:
        return Finding("layouts", "problem", error.message, error.remedy)
    return Finding("layouts", "ok", f"{count} enrolled, version {registry.version}, in {path}")


def _ports() -> Finding:
    ports = sorted(str(path) for kind in ("ttyACM*", "ttyUSB*") for path in Path("/dev").glob(kind))
    if not ports:
        return Finding("serial ports", "ok", "none")
    locked = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if locked:
        remedy = "Add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again."
        return Finding("serial ports", "warning", f"no permission for {', '.join(locked)}", remedy)
    return Finding("serial ports", "ok", ", ".join(ports))


def _same(installed: Path, shipped: Path) -> bool:
    try:
        return read_bytes(installed, _MAX_RULE) == read_bytes(shipped, _MAX_RULE)
    except (StorageError, FileFormatError):
        return False


def _system() -> list[Finding]:
    """The udev rule and the systemd unit of the package, and how to install them; Linux only."""
    if platform.system() != "Linux":
        return []
    folder = Path(__file__).resolve().parent / "system"
    rule, unit = folder / "70-tagid.rules", folder / "tagid-station.service"
    candidates = [
        Path(root) / "udev" / "rules.d" / rule.name for root in ("/etc", "/run", "/usr/lib", "/lib")
    ]
    installed = next((place for place in candidates if place.exists()), None)
    if installed is not None and _same(installed, rule):
        access = Finding("device access", "ok", f"udev rule {installed}")
    elif installed is not None:
        access = Finding(
            "device access", "warning", f"{installed} is of another version", _install_rule(rule)
        )
    else:
        access = Finding(
            "device access", "ok", "no udev rule, needed if access to ports is denied", _install_rule(rule)
        )
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "systemd" / "user"
    if (home / unit.name).exists():
        service = Finding("service", "ok", f"{home / unit.name}")
    else:
        remedy = (
            f"To start the station at login: `mkdir -p {home} && cp {unit} {home}/ && "
            "systemctl --user enable --now tagid-station`"
        )
        service = Finding(
            "service", "ok", "no systemd unit, needed to start the station automatically", remedy
        )
    return [access, service]


def _install_rule(rule: Path) -> str:
    return (
        f"To install it: `sudo cp {rule} /etc/udev/rules.d/ && sudo udevadm control --reload && "
        "sudo udevadm trigger`"
    )


def _axis(config: Config) -> Finding:
    distance = config["motion.axis_distance_m"]
    if distance is None:
        remedy = "Measure it: `tagid config set motion.axis_distance_m METRES`"
        return Finding("axis distance", "warning", "not set", remedy)
    return Finding("axis distance", "ok", f"{distance:.4g} m")


def _rig(config: Config, serial: int | None) -> Finding:
    """The profile of the rig, and what contradicts it: settings, or the radar of a serial number."""
    from tagid.rig import installed_profile

    profile = installed_profile(data_folder())
    if profile is None:
        return Finding(
            "rig", "ok", "not commissioned", "To measure delay, axis, pulse and gain: `tagid commission`"
        )
    text = f"rig of {profile.day}, radar {profile.radar.serial}"
    delay, expected = config["radar.cable_delay_ps"], profile.path_delay_ps
    axis, measured = config["motion.axis_distance_m"], profile.axis_distance_m
    odd = []
    if abs(delay - expected.value) > 3 * expected.sigma:
        odd.append(f"the delay in use is {delay - expected.value:+.0f} ps off")
    if axis is not None and abs(axis - measured.value) > 3 * measured.sigma:
        odd.append(f"the axis distance in use is {1e3 * (axis - measured.value):+.0f} mm off")
    if serial is not None and profile.radar.serial and serial != profile.radar.serial:
        remedy = "Commission this radar: `tagid commission`."
        return Finding("rig", "warning", f"{text}: the connected radar is {serial}", remedy)
    if odd:
        remedy = (
            "Remove the setting (`tagid config unset NAME`) to use the profile, or repeat `tagid commission`."
        )
        return Finding("rig", "warning", f"{text}: {'; '.join(odd)}", remedy)
    return Finding("rig", "ok", text)


def _radar(config: Config, needed: bool) -> tuple[Finding, int | None]:
    """Whether the radar answers, and its serial number."""
    from tagid.radar.survey import survey
    from tagid.recording.radars import open_radar

    url = config["radar.url"]
    silent = partial(Finding, "radar", answers=False)
    if not url:
        remedy = "`tagid config set radar.url udp://192.168.1.100` (kit units: .100 to .103)"
        return silent("problem" if needed else "warning", "none configured", remedy), None
    try:
        state = survey(open_radar(url, config["radar.timeout_s"]))
    except TagidError as error:
        return silent("problem", f"{url}: {error.message}", error.remedy), None
    level: Level = "ok"
    status, remedy = state.status, ""
    text = f"{url} answers: serial {status.serial}, MRM {status.mrm_version}, {status.temperature_c:.1f} degC"
    if state.config is not None:
        text += f", {state.config.samples} samples"
    if status.built_in_test:
        level, text = "problem", f"{text}, self test {status.built_in_test}"
        remedy = "Power-cycle the radar; if the error persists, the unit needs service."
    elif odd := state.warnings():
        level, text, remedy = "warning", f"{text}; {'; '.join(odd)}", "`tagid radar info` shows more."
    return Finding("radar", level, text, remedy, answers=True), status.serial
