"""Motion devices by URL, as the command line and the configuration name them.

One table of what works, so that an unknown name is answered with it.
"""

from __future__ import annotations

from urllib.parse import parse_qsl, urlsplit

from tagid.errors import UsageError
from tagid.motion.turntable import FreeTurntable

SUPPORTED = ("free", "free?rpm=2", "free?rpm=2&direction=cw", "emulator://helmet-120?rpm=2")
_PLANNED = ("roomba", "roomba+serial", "roomba+ble", "comxim+serial", "revopoint+ble")
_DIRECTIONS = {"ccw": 1, "cw": -1}


def _bad(url: str, why: str) -> UsageError:
    return UsageError(f"motion {url[:200]!r}: {why}", f"Use one of {', '.join(SUPPORTED)}.")


def _number(url: str, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _bad(url, f"{name} is {text[:50]!r}, not a number") from None


def open_motion(url: str) -> FreeTurntable:
    """The motion device of a URL; nothing is connected yet.

    `free` takes rpm (turns a minute), direction (ccw, the default, or cw) and max_seconds (how long to wait
    for a period where rpm is not given). `emulator://SCENE?rpm=...` is the emulated radar's own table, which
    runs freely; options of the scene are ignored here.

    >>> open_motion("free?rpm=2&direction=cw").needed_seconds()
    39.0

    Raises:
        UsageError: malformed, unknown, or not supported yet.
    """
    try:
        parts = urlsplit(url)
        options = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise _bad(url, "is malformed") from None
    names = [name for name, _ in options]
    if len(set(names)) != len(names):
        raise _bad(url, "names an option twice")
    if parts.scheme in _PLANNED:
        raise _bad(url, f"{parts.scheme} is not supported yet")
    if parts.scheme == "emulator":
        if not parts.netloc:
            raise _bad(url, "names no scene")
        given = {k: v for k, v in options if k in ("rpm", "direction", "max_seconds")}
    elif not parts.scheme and not parts.netloc and parts.path == "free":
        given = dict(options)
    else:
        raise _bad(url, "is unknown")
    if unknown := sorted(set(given) - {"rpm", "direction", "max_seconds"}):
        raise _bad(url, f"option {unknown[0][:50]!r} is unknown")
    direction = given.get("direction", "ccw")
    if direction not in _DIRECTIONS:
        raise _bad(url, f"direction is {direction[:50]!r}, not cw or ccw")
    rpm = _number(url, "rpm", given["rpm"]) if "rpm" in given else None
    seconds = _number(url, "max_seconds", given["max_seconds"]) if "max_seconds" in given else 120.0
    return FreeTurntable(rpm, _DIRECTIONS[direction], seconds)
