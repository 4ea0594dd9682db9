"""Radar URLs: their syntax, and the link that a udp:// or serial:// URL opens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, unquote, urlsplit

from tagid.errors import UsageError
from tagid.query import Query
from tagid.radar.framing import Framing
from tagid.radar.links import DEFAULT_PORT, Link, UdpLink
from tagid.secret import masked

WHAT_WORKS: Final = (
    "Give udp://HOST[:PORT] (a P440 in a network), serial:///dev/ttyACM0 (on USB), "
    "serial:///dev/ttyUSB0?framing=uart&baud=115200 (on its UART), replay://FILE (a recording) or "
    "emulator://SCENE?seed=1 (a simulated radar)."
)


@dataclass(frozen=True)
class RadarUrl:
    """A parsed radar URL.

    Attributes:
        scheme: "udp", "serial", "replay" or "emulator".
        target: host, device file, file path or scene name.
        port: UDP port; 0 for other schemes.
        options: parameters after the question mark.
    """

    scheme: str
    target: str
    port: int
    options: dict[str, str]


def parse_radar_url(url: str) -> RadarUrl:
    """Parse a radar URL. Raises UsageError that lists the valid forms.

    >>> parse_radar_url("udp://192.168.1.100").port
    21210
    >>> parse_radar_url("emulator://helmet-120?seed=1").options
    {'seed': '1'}
    """
    scheme, separator, rest = url.partition("://")
    if not separator:
        raise UsageError(f"radar {masked(url)!r} is not a URL", WHAT_WORKS)
    path, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError as error:
        raise UsageError(f"radar {masked(url)!r}: the options cannot be read", WHAT_WORKS) from error
    options = dict(pairs)
    if scheme not in _TARGET_NAMES:
        raise UsageError(f"radar {masked(url)!r}: {masked(scheme)}:// is unknown", WHAT_WORKS)
    if not path.strip("/"):
        raise UsageError(f"radar {masked(url)!r} names no {_TARGET_NAMES[scheme]}", WHAT_WORKS)
    if scheme != "udp":
        return RadarUrl(scheme, unquote(path), 0, options)
    try:
        parts = urlsplit(f"udp://{path}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(f"radar {masked(url)!r} has a bad address or port", WHAT_WORKS) from error
    if not host or parts.path.strip("/") or parts.username or port == 0:
        raise UsageError(f"radar {masked(url)!r} has a bad address or port", WHAT_WORKS)
    if options:
        raise UsageError(f"radar {masked(url)!r}: udp:// takes no options", WHAT_WORKS)
    return RadarUrl(scheme, host, port or DEFAULT_PORT, {})


@dataclass
class RadarOptions(Query):
    """Options of a radar URL, or of an emulated radar.

    Attributes:
        source: what they belong to, as given.
        given: options not yet taken.
        remedy: of the errors.
    """

    source: str
    given: dict[str, str]
    remedy: str = WHAT_WORKS

    def wrong(self, why: str) -> UsageError:
        return UsageError(masked(f"{self.source[:200]}: {why}"), self.remedy)


_TARGET_NAMES: Final = {"udp": "host", "serial": "port", "replay": "file", "emulator": "scene"}


def open_link(url: str) -> Callable[[], Link]:
    """A function that opens the link of a udp:// or serial:// URL; the URL itself is validated at once.

    Raises UsageError for another scheme, a bad address or a bad option. Calling the result raises DeviceError
    for an unknown host, or a port that is missing, in use or not permitted.
    """
    parsed = parse_radar_url(url)
    if parsed.scheme == "udp":
        return lambda: UdpLink(parsed.target, parsed.port)
    if parsed.scheme != "serial":
        raise UsageError(f"radar {masked(url)!r} is not a udp:// or serial:// URL", WHAT_WORKS)
    from tagid.radar.serial_link import BAUD_RATES, DEFAULT_BAUD, SerialLink, SerialPort

    options = RadarOptions(f"radar {masked(url)!r}", dict(parsed.options))
    framing_name = options.text("framing", "usb")
    baud = options.whole("baud", DEFAULT_BAUD, min(BAUD_RATES), max(BAUD_RATES))
    options.done()
    if not parsed.target.startswith("/"):
        raise UsageError(f"radar {masked(url)!r} names no device file", WHAT_WORKS)
    if framing_name not in ("usb", "uart"):
        raise UsageError(
            f"radar {masked(url)!r}: framing is {framing_name!r}", "Give framing=usb or framing=uart."
        )
    port = SerialPort(parsed.target, Framing(framing_name), baud)
    return lambda: SerialLink(port)
