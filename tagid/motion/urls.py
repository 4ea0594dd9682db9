"""Creates motion devices from URLs, as used on the command line and in the configuration.

A device with a link has its own file and one line in the entry-point table `tagid.motion` in pyproject.toml;
devices without a link are here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, cast
from urllib.parse import parse_qsl, unquote, urlsplit

from tagid.errors import UsageError
from tagid.motion.device import Motion
from tagid.motion.turntable import FreeTurntable
from tagid.query import Query
from tagid.secret import MotionUrl, Secret, masked

ENTRY_POINTS: Final = "tagid.motion"
"""Group of entry points: URL scheme = "module:function" of a function (Options) -> Motion."""
EXAMPLES: Final = (
    "free",
    "free?rpm=2",
    "free?rpm=2&direction=cw",
    "roomba+serial:///dev/ttyUSB1",
    "roomba+ble://NAME",
    "index+ble://NAME",
    "comxim+serial:///dev/ttyUSB1",
    "revopoint+ble",
    "emulator://helmet-120?rpm=2",
)
_DIRECTIONS: Final = {"ccw": 1, "cw": -1}


@dataclass
class Options(Query):
    """A parsed device URL.

    Attributes:
        url: as given, without its pass-key.
        scheme: before "://".
        target: device file, name or address; "" if none is given.
        given: options not yet taken.
        passkey: not yet taken.
        stopping: the device is only to be stopped: files that this does not need are not read, and the
            configuration is ignored where it cannot be used.
    """

    url: str
    scheme: str
    target: str
    given: dict[str, str]
    passkey: Secret | None = None
    stopping: bool = False

    def wrong(self, why: str) -> UsageError:
        return bad_url(self.url, why)

    def secret(self) -> Secret | None:
        """The pass-key."""
        passkey, self.passkey = self.passkey, None
        return passkey

    def port(self) -> str:
        """The target as a device file, by the same name from every folder. Raises UsageError without one."""
        if not self.target:
            raise self.wrong("the port is missing")
        return str(Path(self.target).absolute())

    def direction(self) -> int:
        """The option `direction`: +1 for ccw (the default), -1 for cw."""
        text = self.given.pop("direction", "ccw")
        if text not in _DIRECTIONS:
            raise self.wrong(f"direction is {text[:50]!r}, not cw or ccw")
        return _DIRECTIONS[text]

    def reversed(self, device: str) -> bool:
        """The option `reversed`: 1 if the device turns opposite to its documents.

        Without it, the result of `tagid motion calibrate --direction` for this device; otherwise 0.
        """
        from tagid.motion.calibration import recall_reversed

        given = self.number("reversed", None, 0, 1)
        return recall_reversed(device) if given is None and not self.stopping else bool(given)

    def done(self) -> None:
        if self.passkey:
            raise self.wrong("option 'passkey' is unknown")
        super().done()


def bad_url(url: str | MotionUrl, why: str) -> UsageError:
    """The error for a motion URL, with the valid forms."""
    return UsageError(
        f"motion {str(MotionUrl(url))[:200]!r}: {masked(why)}", f"Use one of {', '.join(EXAMPLES)}."
    )


def parse_motion_url(url: str | MotionUrl) -> Options:
    """Parse a motion URL. Raises UsageError.

    >>> parse_motion_url("roomba+serial:///dev/ttyUSB1?step=2").target
    '/dev/ttyUSB1'
    """
    url = MotionUrl(url)
    try:
        parts = urlsplit(url.reveal())
        pairs = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise bad_url(url, "malformed URL") from None
    names = [name for name, _ in pairs]
    if len(set(names)) != len(names):
        raise bad_url(url, "an option is given twice")
    given = dict(pairs)
    digits = given.pop("passkey", "")
    passkey = Secret(digits) if digits else None
    if not parts.scheme:
        if parts.netloc or not parts.path:
            raise bad_url(url, "no such device")
        return Options(url.public, unquote(parts.path), "", given, passkey)
    # The case of the part before the path is preserved: it may be a Bluetooth name.
    return Options(url.public, parts.scheme, unquote(parts.netloc + parts.path), given, passkey)


def open_motion(url: str | MotionUrl, stopping: bool = False) -> Motion:
    """The motion device of a URL; nothing is connected.

    `free` takes rpm (turns per minute), direction (ccw, the default, or cw), max_seconds (how long to wait
    for a period if rpm is not given) and marker=1 (a reflector off the axis breaks the object's symmetry).
    `emulator://SCENE?rpm=...` is the emulated radar's own table, which runs freely; options of the scene are
    ignored here. docs/motion.md describes all others. With `stopping` the device is only to be stopped
    (`Options`).

    >>> open_motion("free?rpm=2&direction=cw").needed_seconds()
    39.0

    Raises:
        UsageError: malformed or unknown. MissingExtraError: a package that it needs is not installed.
    """
    options = parse_motion_url(url)
    options.stopping = stopping
    if options.scheme == "emulator":
        if not options.target:
            raise options.wrong("the scene is missing")
        known = ("rpm", "direction", "max_seconds", "marker")
        return _free(Options(options.url, "free", "", {k: v for k, v in options.given.items() if k in known}))
    if options.scheme == "free" and not options.target:
        return _free(options)
    entry = next(iter(metadata.entry_points(group=ENTRY_POINTS, name=options.scheme)), None)
    if entry is None:
        raise options.wrong("no such device")
    factory = cast(Callable[[Options], Motion], entry.load())
    device = factory(options)
    options.done()
    return device


def _free(options: Options) -> FreeTurntable:
    rpm = options.number("rpm", None, 0.0, 1000.0)
    seconds = options.number("max_seconds", 120.0, 0.0, 3600.0)
    marker = options.number("marker", 0, 0, 1)
    table = FreeTurntable(rpm, options.direction(), seconds, marker=bool(marker))
    options.done()
    return table
