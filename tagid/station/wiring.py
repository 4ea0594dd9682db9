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
    """What to check to connect the radar of a URL, in this order.

    The cable is "none" if no radar is configured, or an emulated one; the URL is empty if there is none.
    """

    cable: Cable
    url: str
    steps: tuple[str, ...]


_POWER = "Switch the radar on and look at its power light."
_FIND = "Search for it under Settings, or run `tagid radar find` on this computer."
_STEPS: dict[Cable, tuple[str, ...]] = {
    "none": (
        _POWER,
        "Connect it to this computer by Ethernet or USB, and wait 15 seconds while it boots.",
        f"{_FIND} This page continues by itself once it is chosen.",
    ),
    "ethernet": (
        f"{_POWER} It answers 7 seconds later.",
        "Plug the network cable into the radar and into this computer, or both into one switch. The lights "
        "at both ends are on.",
        "The radar is expected at {target}. This computer needs an address in the same network, e.g. "
        "192.168.1.1 with the mask 255.255.255.0.",
        "A firewall must accept UDP from port {port}.",
        f"Still nothing? {_FIND}",
    ),
    "usb": (
        f"{_POWER} It answers 11 seconds later.",
        "Plug the USB cable into the radar and into this computer; the radar is expected at {target}.",
        "Another name after replugging? Use the one in /dev/serial/by-id, which does not change.",
        "No permission? Add yourself to the group dialout and log in again.",
        f"Still nothing? {_FIND}",
    ),
    "uart": (
        f"{_POWER} It answers a few seconds later.",
        "Connect the adapter at {target}: its transmit line to the radar's receive line, its receive line "
        "to the radar's transmit line, ground to ground.",
        "Both ends need the same baud rate; 115200 is the factory setting.",
        "No permission? Add yourself to the group dialout and log in again.",
        "Still nothing? `tagid radar find --ask serial://{target}?framing=uart` queries this port.",
    ),
}


def wiring(url: str | None) -> Wiring:
    if not url:
        return Wiring("none", "", _STEPS["none"])
    try:
        parsed = parse_radar_url(url)
    except UsageError as error:
        return Wiring("none", url, (f"{error.message}. {error.remedy}",))
    if parsed.scheme not in ("udp", "serial"):
        return Wiring("none", url, (f"The configured radar is {url}, which is not a device.", _FIND))
    serial: Cable = "uart" if parsed.options.get("framing") == "uart" else "usb"
    cable: Cable = "ethernet" if parsed.scheme == "udp" else serial
    return Wiring(cable, url, tuple(s.format(target=parsed.target, port=parsed.port) for s in _STEPS[cable]))
