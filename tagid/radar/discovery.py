"""Discovery of radars: serial ports with a radar's USB number, and configured addresses that answer.

All candidates are queried in parallel, so the search ends within three seconds even if many are silent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from tagid.errors import ConfigError, TagidError
from tagid.radar.links import DEFAULT_PORT
from tagid.radar.p440 import P440
from tagid.radar.status import RadarStatus
from tagid.radar.urls import open_link
from tagid.workers import Worker

USB_VENDOR: Final = 0x1027
USB_PRODUCTS: Final = {0x0005: "P440", 0x0003: "P410"}
"""USB numbers 1027:0005 and 1027:0003, as Linux shows them (hexadecimal)."""

_ASKING_S: Final = 2.1
"""`tagid radar find` is to end within three seconds, the start of the program included."""
_ANSWER_S: Final = 0.65
_ATTEMPTS: Final = 3
_MOST_ADDRESSES: Final = 64

WHERE_TO_LOOK: Final = (
    "Check power (a P440 boots for 7 to 11 s) and cable. On Ethernet, give this computer 192.168.1.1/24 and "
    "allow UDP port 21210 in the firewall. Other addresses: `radar.addresses`."
)


@dataclass(frozen=True)
class FoundRadar:
    """A radar, or a port that should have one.

    Attributes:
        url: the value for --radar.
        kind: "network", "P440 on USB", "P410 on USB" or "serial".
        status: its status; None if it did not answer.
        problem, remedy: why it did not answer, and what to do; empty if it did.
    """

    url: str
    kind: str
    status: RadarStatus | None
    problem: str = ""
    remedy: str = ""


@dataclass(frozen=True)
class Search:
    """Result of a search.

    Attributes:
        radars: the radars found, and serial ports that did not answer; silent network addresses are omitted.
        asked: URLs of all candidates.
        seconds: duration of the search, s.
    """

    radars: tuple[FoundRadar, ...]
    asked: tuple[str, ...]
    seconds: float


def addresses_from(text: str | None) -> tuple[str, ...]:
    """The addresses of the setting `radar.addresses`: HOST or HOST:PORT, separated by commas or spaces.

    Raises ConfigError if there are more than 64.

    >>> addresses_from("127.0.0.1:5000, 127.0.0.1:5001")
    ('127.0.0.1:5000', '127.0.0.1:5001')
    """
    parts = (part.removeprefix("udp://") for part in (text or "").replace(",", " ").split())
    addresses = tuple(dict.fromkeys(parts))
    if len(addresses) > _MOST_ADDRESSES:
        raise ConfigError(
            f"radar.addresses has {len(addresses)} addresses",
            f"Give at most {_MOST_ADDRESSES}, separated by commas.",
        )
    return addresses


def radar_ports() -> list[tuple[str, str]]:
    """(URL, kind) of the serial ports with the USB number of a P440 or P410."""
    from serial.tools import list_ports

    return [
        (f"serial://{port.device}", f"{USB_PRODUCTS[port.pid]} on USB")
        for port in sorted(list_ports.comports(), key=lambda port: str(port.device))
        if port.vid == USB_VENDOR and port.pid in USB_PRODUCTS
    ]


def discover(
    addresses: Sequence[str],
    urls: Sequence[str] = (),
    ports: Callable[[], list[tuple[str, str]]] = radar_ports,
) -> Search:
    """Query the status of every candidate in parallel; a scanning radar continues scanning.

    Candidates are addresses HOST or HOST:PORT, for UDP, further URLs, e.g. of a UART adapter, which cannot be
    recognised by its USB number, and the serial ports that `ports` lists.

    Raises UsageError for an invalid address or URL.
    """
    started = time.monotonic()
    candidates: dict[str, str] = {}
    for address in addresses:
        candidates.setdefault(
            f"udp://{address}" if ":" in address else f"udp://{address}:{DEFAULT_PORT}", "network"
        )
    for url, kind in ports():
        candidates.setdefault(url, kind)
    for url in urls:
        candidates.setdefault(url, "network" if url.startswith("udp:") else "serial")
    answers: dict[str, FoundRadar] = {}
    openers = {url: open_link(url) for url in candidates}
    workers = {
        url: Worker(partial(_ask, url, kind, openers[url], answers), "radar-find")
        for url, kind in candidates.items()
    }
    for worker in workers.values():
        with suppress(RuntimeError):
            worker.start()
    for worker in workers.values():
        worker.join(max(started + _ASKING_S - time.monotonic(), 0.0))
    radars = []
    for url, kind in candidates.items():
        failure = workers[url].failure
        problem = "did not answer in time" if failure is None else f"could not be asked: {failure!r}"
        radar = answers.get(url, FoundRadar(url, kind, None, problem, WHERE_TO_LOOK))
        if radar.status is not None or kind != "network" or url in urls:
            radars.append(radar)
    return Search(tuple(radars), tuple(candidates), time.monotonic() - started)


def _ask(url: str, kind: str, opener: Callable[[], Any], answers: dict[str, FoundRadar]) -> None:
    try:
        link = opener()
        try:
            answers[url] = FoundRadar(url, kind, P440(link, _ANSWER_S, _ATTEMPTS).status())
        finally:
            link.close()
    except TagidError as error:
        answers[url] = FoundRadar(url, kind, None, error.message, error.remedy)
