"""Radar URLs: which link and which device stand behind `--radar`.

Whatever the URL names, the caller gets the same client; the `sources` it brings open scenes and files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol
from urllib.parse import parse_qsl, unquote, urlsplit

from tagid.errors import UsageError
from tagid.radar.emulator_core import EmulatorCore
from tagid.radar.faults import Faults
from tagid.radar.framing import Framing
from tagid.radar.links import DEFAULT_PORT, Link, UdpLink
from tagid.radar.memory import MemoryLink
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.radar.sources import RecordingSource, ScanSource

WHAT_WORKS: Final = (
    "Give udp://HOST[:PORT] (a P440 in a network), serial:///dev/ttyACM0 (on USB), "
    "serial:///dev/ttyUSB0?framing=uart&baud=115200 (on its UART), replay://FILE (a recording) or "
    "emulator://SCENE?seed=1 (a simulated radar)."
)
_FAULT_OPTIONS: Final = ("lose", "lose_requests", "duplicate", "reorder", "delay", "delay_s")


class SourceFactory(Protocol):
    """Opens what an emulated radar sees; brought by the caller because it needs simulation and storage."""

    def recording(self, path: Path, loop: bool) -> RecordingSource:
        """The recording in a file. Raises the reader's errors."""
        ...

    def scene(self, name: str, options: dict[str, str]) -> ScanSource:
        """The scene of that name. Raises UsageError for an unknown scene or option."""
        ...


@dataclass(frozen=True)
class RadarUrl:
    """A radar URL taken apart.

    Attributes:
        scheme: "udp", "serial", "replay" or "emulator".
        target: host, device file, file path or scene name.
        port: UDP port; 0 for other schemes.
        options: what stands behind the question mark.
    """

    scheme: str
    target: str
    port: int
    options: dict[str, str]


def parse_radar_url(url: str) -> RadarUrl:
    """Takes a radar URL apart. Raises UsageError with what would work.

    >>> parse_radar_url("udp://192.168.1.100").port
    21210
    >>> parse_radar_url("emulator://helmet-120?seed=1").options
    {'seed': '1'}
    """
    scheme, separator, rest = url.partition("://")
    if not separator:
        raise UsageError(f"radar {url!r} is not a URL", WHAT_WORKS)
    path, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError as error:
        raise UsageError(f"radar {url!r}: the options {query!r} cannot be read", WHAT_WORKS) from error
    options = dict(pairs)
    if scheme not in _TARGET_NAMES:
        raise UsageError(f"radar {url!r}: {scheme}:// is unknown", WHAT_WORKS)
    if not path.strip("/"):
        raise UsageError(f"radar {url!r} names no {_TARGET_NAMES[scheme]}", WHAT_WORKS)
    if scheme != "udp":
        return RadarUrl(scheme, unquote(path), 0, options)
    try:
        parts = urlsplit(f"udp://{path}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(f"radar {url!r} has a bad address or port", WHAT_WORKS) from error
    if not host or parts.path.strip("/") or parts.username or port == 0:
        raise UsageError(f"radar {url!r} has a bad address or port", WHAT_WORKS)
    if options:
        raise UsageError(f"radar {url!r}: udp:// takes no options", WHAT_WORKS)
    return RadarUrl(scheme, host, port or DEFAULT_PORT, {})


_TARGET_NAMES: Final = {"udp": "host", "serial": "port", "replay": "file", "emulator": "scene"}


def open_link(url: str) -> Callable[[], Link]:
    """What opens the wire that a udp:// or serial:// URL names; the URL itself is judged at once.

    Raises UsageError for another scheme, a bad address or a bad option. Calling the result raises DeviceError
    for an unknown host or a port that is missing, taken or forbidden.
    """
    parsed = parse_radar_url(url)
    if parsed.scheme == "udp":
        return lambda: UdpLink(parsed.target, parsed.port)
    if parsed.scheme != "serial":
        raise UsageError(f"radar {url!r} stands on no wire", WHAT_WORKS)
    options = dict(parsed.options)
    framing_name, baud_text = options.pop("framing", "usb"), options.pop("baud", None)
    if options:
        raise UsageError(f"radar {url!r}: option {next(iter(options))!r} is unknown", WHAT_WORKS)
    if not parsed.target.startswith("/"):
        raise UsageError(f"radar {url!r} names no device file", WHAT_WORKS)
    if framing_name not in ("usb", "uart"):
        raise UsageError(f"radar {url!r}: framing is {framing_name!r}", "Give framing=usb or framing=uart.")
    from tagid.radar.serial_link import BAUD_RATES, DEFAULT_BAUD, SerialLink, SerialPort

    baud = DEFAULT_BAUD if baud_text is None else int(_number(url, "baud", baud_text))
    if baud not in BAUD_RATES:
        raise UsageError(f"radar {url!r}: baud is {baud}", "Give 9600 to 921600; at delivery: 115200.")
    port = SerialPort(parsed.target, Framing(framing_name), baud)
    return lambda: SerialLink(port)


def open_radar(url: str, sources: SourceFactory, timeout: float = 1.0) -> P440:
    """The client of the radar that a URL names, not connected yet (enter it as a context manager).

    Options that every emulated radar takes: `rate` (emulated seconds per second; 0, the default, never waits)
    and the fault probabilities `lose`, `lose_requests`, `duplicate`, `reorder`, `delay`, with `delay_s`;
    `replay://` also takes `loop=1`. All others, and `seed`, go to the scene.

    Raises:
        UsageError: unknown scheme, bad address, bad option.
        DeviceError: unknown host, no network; no such port, taken or forbidden.
    """
    parsed = parse_radar_url(url)
    if parsed.scheme in ("udp", "serial"):
        return P440(open_link(url)(), timeout)
    options = dict(parsed.options)
    rate = _number(url, "rate", options.pop("rate", "0"))
    if not 0 <= rate <= 1e6:
        raise UsageError(f"radar {url!r}: rate is {rate}", "Give 1 for real time, 0 for no waiting.")
    levels = {name: _number(url, name, options.pop(name)) for name in _FAULT_OPTIONS if name in options}
    seed = int(_number(url, "seed", options.get("seed", "0")))
    faults = Faults(**levels, seed=seed)
    if parsed.scheme == "emulator":
        core = EmulatorCore(sources.scene(parsed.target, options), RadarConfig())
        return P440(MemoryLink(core, rate, faults, url), timeout)
    loop = options.pop("loop", "0") not in ("0", "")
    options.pop("seed", None)
    if options:
        raise UsageError(
            f"radar {url!r}: option {next(iter(options))!r} is unknown", "replay:// takes rate and loop."
        )
    recording = sources.recording(Path(parsed.target), loop)
    return P440(MemoryLink(EmulatorCore(recording), rate, faults, url), timeout)


def _number(url: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise UsageError(f"radar {url!r}: {name} is {text!r}", f"Give a number for {name}.") from error
    if value != value or abs(value) == float("inf"):
        raise UsageError(f"radar {url!r}: {name} is {text!r}", f"Give a finite number for {name}.")
    return value
