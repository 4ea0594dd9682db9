"""Settings of the fit as words of a command line or a configuration, `robust=3,calibrate=axis+wobble`.

One option with names, instead of an option for each, so that a new setting needs no new option anywhere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from tagid.errors import UsageError
from tagid.imaging.ats.settings import AtsSettings

NOT_WORDS = ("preset", "seed", "engine", "device")
"""Settings with options of their own."""


def setting_names() -> list[str]:
    """Names that `parse_settings` takes."""
    return [f.name for f in fields(AtsSettings) if f.name not in NOT_WORDS]


def parse_settings(words: Iterable[str]) -> dict[str, Any]:
    """Arguments for `AtsSettings` of words KEY=VALUE, each of which may hold several after commas.

    Values of a list are joined by "+": `calibrate=axis+wobble`.

    Raises:
        UsageError: a name that does not exist, or a value of the wrong kind.
    """
    found: dict[str, Any] = {}
    defaults = AtsSettings()
    for part in (p.strip() for word in words for p in word.split(",")):
        if not part:
            continue
        name, equals, text = (t.strip() for t in part.partition("="))
        if not equals or name not in setting_names():
            raise UsageError(
                f"there is no ATS setting {part!r}", f"Give KEY=VALUE with {', '.join(setting_names())}."
            )
        found[name] = _value(name, text, getattr(defaults, name))
    return found


def parse_calibrate(text: str) -> tuple[str, ...]:
    """What is learned beside the scene, of `axis,wobble,gain,static`; commas or "+" between."""
    return tuple(dict.fromkeys(p.strip() for p in text.replace("+", ",").split(",") if p.strip()))


def _value(name: str, text: str, default: Any) -> Any:
    if isinstance(default, tuple):
        return parse_calibrate(text)
    kind = type(default)
    try:
        return kind(text)
    except ValueError:
        words = {int: "a whole number", float: "a number"}[kind]
        raise UsageError(f"ATS setting {name} is {text!r}, expected {words}", f"Give {words}.") from None
