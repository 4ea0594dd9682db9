"""How to connect the radar, shown when the health check does not find it.

Facts: docs/radar.md, "Wiring and addressing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tagid.errors import UsageError
from tagid.radar.urls import parse_radar_url

Cable = Literal["ethernet", "usb", "uart", "none"]


@dataclass(frozen=True)
class Wiring:
    """Instructions for connecting the radar.

    Attributes:
        cable: the cable of the configured URL; "none" if no radar is configured, or an emulated one.
        url: the configured URL; empty if there is none.
        steps: what to check, in this order.
    """

    cable: Cable
    url: str
    steps: tuple[str, ...]


def wiring(url: str | None) -> Wiring:
    """Instructions for the radar at a URL."""
    if not url:
        return Wiring("none", "", _UNKNOWN)
    try:
        parsed = parse_radar_url(url)
    except UsageError as error:
        return Wiring("none", url, (f"{error.message}. {error.remedy}",))
    if parsed.scheme == "udp":
        return Wiring("ethernet", url, _ethernet(parsed.target, parsed.port))
    if parsed.scheme == "serial":
        uart = parsed.options.get("framing") == "uart"
        return Wiring("uart" if uart else "usb", url, (_uart if uart else _usb)(parsed.target))
    return Wiring("none", url, (f"The configured radar is {url}, which is not a device.", _FIND))


_POWER = "Switch the radar on and look at its power light."
_FIND = "Search for it under Settings, or run `tagid radar find` on this computer."
_UNKNOWN = (
    _POWER,
    "Connect it to this computer by Ethernet or USB, and wait 15 seconds while it boots.",
    f"{_FIND} This page continues by itself once it is chosen.",
)


def _ethernet(host: str, port: int) -> tuple[str, ...]:
    return (
        f"{_POWER} It answers 7 seconds later.",
        "Plug the network cable into the radar and into this computer, or both into one switch. The lights "
        "at both ends are on.",
        f"The radar is expected at {host}. This computer needs an address in the same network, e.g. "
        "192.168.1.1 with the mask 255.255.255.0.",
        f"A firewall must accept UDP from port {port}.",
        f"Still nothing? {_FIND}",
    )


def _usb(port: str) -> tuple[str, ...]:
    return (
        f"{_POWER} It answers 11 seconds later.",
        f"Plug the USB cable into the radar and into this computer; the radar is expected at {port}.",
        "Another name after replugging? Use the one in /dev/serial/by-id, which does not change.",
        "No permission? Add yourself to the group dialout and log in again.",
        f"Still nothing? {_FIND}",
    )


def _uart(port: str) -> tuple[str, ...]:
    return (
        f"{_POWER} It answers a few seconds later.",
        f"Connect the adapter at {port}: its transmit line to the radar's receive line, its receive line "
        "to the radar's transmit line, ground to ground.",
        "Both ends need the same baud rate; 115200 is the factory setting.",
        "No permission? Add yourself to the group dialout and log in again.",
        f"Still nothing? `tagid radar find --ask {'serial://' + port}?framing=uart` queries this port.",
    )
