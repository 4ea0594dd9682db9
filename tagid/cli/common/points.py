"""Positions in the plane as the text of an option."""

from __future__ import annotations

from tagid.errors import UsageError


def parse_point(option: str, text: str) -> tuple[float, float]:
    """X,Y in metres from the text of an option. Raises UsageError."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise UsageError(f"{option} {text!r} is not X,Y", f"Give metres, e.g. {option} 0.11,-0.02") from None
    return x, y
