"""The settings of the page: radar, motion, axis distance and early ending, in the file of `tagid config set`.

A browser is not trusted. It may choose a device that the station's own search found, a radar at an address
of a private network, or a free-running table; no file, no port and no host name of its choice.
"""

from __future__ import annotations

import ipaddress
import math
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

from tagid.config import Config, change_settings, parse_value
from tagid.errors import ConfigError, TagidError, UsageError
from tagid.motion.discovery import bluetooth_devices, serial_devices
from tagid.motion.urls import open_motion
from tagid.radar.discovery import WHERE_TO_LOOK, addresses_from, discover
from tagid.radar.urls import parse_radar_url
from tagid.secret import MotionUrl
from tagid.station.errors import BusyError

NAMES = ("radar.url", "motion.url", "motion.axis_distance_m", "station.until_sure")
"""Settings that the page shows and may change."""
Kind = Literal["radar", "motion"]
DEVICE_KINDS: tuple[Kind, ...] = get_args(Kind)
LISTEN_S = 4.0
"""Time to listen for Bluetooth devices, s; as `tagid motion find`."""
_FREE = re.compile(r"free(\?rpm=(?P<rpm>[0-9]{1,4}(\.[0-9]{1,4})?)(&direction=(cw|ccw))?)?")
_MOST_RPM = 60.0


@dataclass(frozen=True)
class Device:
    """A device that a search found: the setting's value, empty if it is none, what it is, and its problem.

    The problem, with its remedy, is why it did not answer; empty if it did, or was not asked.
    """

    url: str
    text: str
    problem: str = ""


@dataclass(frozen=True)
class Search:
    """The devices of a search, and what could not be searched, or where to look if nothing was found."""

    devices: tuple[Device, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Shown:
    """A setting: its value without a pass-key, and why the page cannot change it; empty if it can."""

    name: str
    value: str | float | None
    fixed: str


class Settings:
    """The settings of the page and the newest result of each search for devices; thread-safe.

    The lock `radar` is held while radars are asked.
    """

    def __init__(self, radar: threading.Lock) -> None:
        self._radar = radar
        self._lock = threading.Lock()
        self.searches: dict[Kind, Search] = {}

    def find(self, kind: Kind, config: Config) -> Search:
        """Search for devices as `tagid radar find` and `tagid motion find` do; takes some seconds.

        Raises BusyError if a search is running; ConfigError, UsageError for a bad `radar.addresses`.
        """
        with self._alone("a search is running"):
            search = self._radars(config) if kind == "radar" else _motions()
            self.searches[kind] = search
            return search

    def change(self, changes: Mapping[str, Any], config: Config) -> None:
        """Write settings, text or number by name, to the configuration file; all of them, or none.

        Raises:
            UsageError: the page may not set this, a device that it may not choose, or a value out of range.
            StorageError: the file cannot be written.
            BusyError: a search or a change is in progress.
        """
        with self._alone("the settings are being changed or searched"):
            for shown in shown_settings(config):
                if shown.name in changes and shown.fixed:
                    raise UsageError(f"{shown.name} cannot be changed here: {shown.fixed}")
            for name, value in changes.items():
                if name not in NAMES:
                    raise UsageError(f"the page does not set {name[:40]!r}", f"It sets {', '.join(NAMES)}.")
                if isinstance(value, bool) or not isinstance(value, (str, int, float)) or value == "":
                    raise UsageError(f"{name} must be a text or a number")
                try:
                    checked = parse_value(name, value)
                except ConfigError as error:  # of the request, not of the file
                    raise UsageError(error.message, error.remedy) from None
                if name == "radar.url":
                    self._check_radar(checked)
                elif name == "motion.url":
                    self._check_motion(checked)
            if changes:
                change_settings(changes)

    def _check_radar(self, url: str) -> None:
        if self._was_found("radar", url):
            return
        parsed = parse_radar_url(url)
        if parsed.scheme == "udp":
            try:
                if ipaddress.ip_address(parsed.target).is_private:
                    return
            except ValueError:
                pass  # a host name
        raise UsageError(
            f"the page does not set the radar to {url[:100]!r}",
            "Choose one that the search found, or give udp:// with an address of the local network, e.g. "
            "udp://192.168.1.100.",
        )

    def _check_motion(self, url: MotionUrl) -> None:
        if self._was_found("motion", url.public):
            open_motion(url)
            return
        match = _FREE.fullmatch(url.reveal())
        if match is None:
            raise UsageError(
                f"the page does not set the motion to {url.public[:100]!r}",
                "Choose one that the search found, or a free-running table.",
            )
        rpm = match["rpm"]
        if rpm is not None and not (math.isfinite(float(rpm)) and 0 < float(rpm) <= _MOST_RPM):
            raise UsageError(f"the speed is {rpm} rpm", f"Give more than 0 and at most {_MOST_RPM:g} rpm.")

    def _was_found(self, kind: Kind, url: str) -> bool:
        return any(device.url == url for device in self.searches.get(kind, Search()).devices)

    def _radars(self, config: Config) -> Search:
        with self._radar:
            search = discover(addresses_from(config["radar.addresses"]))
        devices = []
        for radar in search.radars:
            status = radar.status
            text = f"{radar.kind}, serial {status.serial}" if status is not None else radar.kind
            problem = f"{radar.problem}. {radar.remedy}".strip() if radar.problem else ""
            devices.append(Device(radar.url, text, problem))
        return Search(tuple(devices), "" if devices else f"No radar replied. {WHERE_TO_LOOK}")

    @contextmanager
    def _alone(self, message: str) -> Iterator[None]:
        if not self._lock.acquire(blocking=False):
            raise BusyError(message, "Wait for its end.")
        try:
            yield
        finally:
            self._lock.release()


def shown_settings(config: Config) -> tuple[Shown, ...]:
    shown = []
    for name in NAMES:
        entry = config.values[name]
        value = entry.value.public if isinstance(entry.value, MotionUrl) else entry.value
        fixed = ""
        if entry.source == "command line":
            fixed = "given when the station was started"
        elif entry.source == "environment":
            fixed = "set in the environment of the station"
        shown.append(Shown(name, value, fixed))
    return tuple(shown)


def _motions() -> Search:
    devices_here, note = serial_devices(), ""
    try:
        devices_here += bluetooth_devices(LISTEN_S)
    except TagidError as error:
        note = f"Bluetooth was not searched: {error.message}. {error.remedy}".strip()
    devices = tuple(
        Device(device.url, f"{device.what} ({device.where})") for device in devices_here if device.url
    )
    if not devices and not note:
        note = "No robot or table was found. Connect its cable, or power the bridge."
    return Search(devices, note)
