"""Bodies and reflectors from text: `can:35mm,handle`, `octahedron:20mm`.

Grammar: NAME[:SIZE][,PART]...[,KEY=LENGTH]... Every length requires a unit, because 35 could be millimetres
or metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from tagid.errors import UsageError
from tagid.query import quantity

_LENGTH = re.compile(r"[+-]?(\d+(?:\.\d+)?|\.\d+)(mm|cm|m)")
MAX_ELEVATION_M = 0.5


@dataclass(frozen=True)
class Shape:
    """Options of a body.

    Attributes:
        size: meaning of its size.
        default_m, least_m, most_m: default and range of the size, m.
        parts: optional parts.
        lengths: KEY=LENGTH options and their ranges, m.
    """

    size: str
    default_m: float
    least_m: float
    most_m: float
    parts: tuple[str, ...] = ()
    lengths: dict[str, tuple[float, float]] = field(default_factory=dict)


_WALLED = {"height": (0.02, 0.5), "oval": (0.0, 0.005)}
_BOX = {"depth": (0.05, 0.5), "height": (0.02, 0.5), "wall": (1e-3, 0.01)}
SHAPES = {
    "can": Shape("radius", 0.033, 0.01, 0.15, ("handle", "seam"), _WALLED),
    "cup": Shape("radius", 0.040, 0.02, 0.15, ("handle", "seam", "filled"), _WALLED | {"wall": (1e-3, 0.01)}),
    "helmet": Shape("longer half axis", 0.101, 0.06, 0.2, ("seam",), {"wall": (1e-3, 0.01)}),
    "box": Shape("side", 0.12, 0.05, 0.5, (), _BOX),
}
_SYNONYMS = {"carton": "box", "mug": "cup"}
REFLECTORS = {"octahedron": (0.005, 0.060)}


@dataclass(frozen=True)
class BodySpec:
    """A requested body; `build` of `objects` creates it.

    Attributes:
        kind: a key of `SHAPES`, or "none".
        size_m: see `Shape.size`.
        parts: of the shape's parts.
        lengths: of the shape's lengths, m.
    """

    kind: str = "none"
    size_m: float = 0.0
    parts: tuple[str, ...] = ()
    lengths: tuple[tuple[str, float], ...] = ()

    def length(self, name: str, otherwise: float) -> float:
        """A given length, or the default."""
        return dict(self.lengths).get(name, otherwise)

    def __str__(self) -> str:
        """The text that `parse_body` accepts."""
        if self.kind == "none":
            return "none"
        more = [*self.parts, *(f"{key}={_text(value)}" for key, value in self.lengths)]
        return ",".join([f"{self.kind}:{_text(self.size_m)}", *more])


@dataclass(frozen=True)
class ReflectorSpec:
    """Requested reflectors: a key of `REFLECTORS` and the size tip to tip, m."""

    kind: str = "octahedron"
    size_m: float = 0.020

    def __str__(self) -> str:
        return f"{self.kind}:{_text(self.size_m)}"


def _text(metres: float) -> str:
    return f"{round(metres * 1e3, 6):g}mm"


def parse_length(option: str, text: str) -> float:
    """Metres from a number with a unit: 35mm, 3.5cm, 0.035m.

    Raises:
        UsageError: number or unit missing, or other text.
    """
    if not _LENGTH.fullmatch(text.strip()):
        raise UsageError(
            f"{option}: {text[:40]!r} is not a length", "Give a number with its unit, mm, cm or m, e.g. 35mm."
        )
    return quantity(text, "m")


def parse_elevation(text: str) -> float:
    """Height of the tag above the plane stated in the capture, m, from `--elevation`. Raises UsageError."""
    value = parse_length("`elevation`", text)
    if abs(value) > MAX_ELEVATION_M:
        raise UsageError(f"`elevation` is {value:g} m", f"Give at most {MAX_ELEVATION_M:g} m up or down.")
    return value


def parse_body(text: str) -> BodySpec:
    """A body from `--body`, e.g. can:35mm, cup:40mm,handle,filled, helmet, box:120mm or none.

    Raises:
        UsageError: unknown body, part or length, or a value out of range.
    """
    name, *rest = text.strip().split(",")
    kind, colon, size_text = name.partition(":")
    if kind == "none" and not colon and not rest:
        return BodySpec()
    kind = _SYNONYMS.get(kind, kind)
    if kind not in SHAPES:
        raise UsageError(
            f"`body`: body {kind[:40]!r} is unknown",
            f"Use {', '.join(SHAPES)} or none, e.g. `body=can:35mm,handle`.",
        )
    shape = SHAPES[kind]
    size = shape.default_m
    if colon:
        size = parse_length(f"`body={kind}`", size_text)
        _check(f"the {shape.size} of a {kind}", size, shape.least_m, shape.most_m)
    parts: list[str] = []
    lengths: dict[str, float] = {}
    for item in rest:
        key, equals, value = item.partition("=")
        if equals and key in shape.lengths and key not in lengths:
            lengths[key] = parse_length(f"`body={kind},{key}`", value)
            _check(f"the {key} of a {kind}", lengths[key], *shape.lengths[key])
        elif not equals and key in shape.parts and key not in parts:
            parts.append(key)
        else:
            known = [*shape.parts, *(f"{name}=LENGTH" for name in shape.lengths)]
            raise UsageError(
                f"`body={kind}`: {item[:40]!r} is unknown or given twice",
                f"Use {', '.join(known)}, each once.",
            )
    return BodySpec(kind, size, tuple(parts), tuple(lengths.items()))


def parse_reflector(text: str) -> ReflectorSpec:
    """Reflectors from `--reflector`, e.g. octahedron:20mm. Raises UsageError."""
    kind, colon, size_text = text.strip().partition(":")
    if kind not in REFLECTORS:
        raise UsageError(
            f"`reflector`: reflector {kind[:40]!r} is unknown", "Use octahedron, e.g. octahedron:20mm."
        )
    size = parse_length(f"`reflector={kind}`", size_text) if colon else ReflectorSpec.size_m
    _check(f"the size of an {kind}", size, *REFLECTORS[kind])
    return ReflectorSpec(kind, size)


def _check(what: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise UsageError(f"{what} is {_text(value)}", f"Give {_text(least)} to {_text(most)}.")
