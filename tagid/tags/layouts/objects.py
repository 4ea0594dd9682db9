"""Objects that carry reflectors, as data: radii and heights at which a reflector can be attached.

A family of layouts is designed for an object, and other objects are defined by their radii, without new code.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

from tagid.errors import UsageError
from tagid.files import parse_toml
from tagid.tags.layouts.layout import KINDS, MAX_HEIGHT_M, MAX_RADIUS_M

MAX_ROWS = 4


@dataclass(frozen=True)
class Row:
    """A circle around the object's axis on which reflectors can be placed.

    Attributes:
        radius_m: radius of the reflectors' centres, m.
        height_m: above the object's plane (that of the first row), m.
    """

    radius_m: float
    height_m: float = 0.0


@dataclass(frozen=True)
class TaggedObject:
    """An object and the rows that can carry reflectors.

    Attributes:
        name: name on the command line.
        kind: kind of its layouts, one of `tagid.tags.layouts.layout.KINDS`.
        rows: the first is the main one; the others are used on request.
        label: readable name.

    Raises UsageError if a row is invalid.
    """

    name: str
    kind: str
    rows: tuple[Row, ...]
    label: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"object {self.name}: kind {self.kind!r} is unknown", f"Use {', '.join(KINDS)}.")
        if not 1 <= len(self.rows) <= MAX_ROWS:
            raise UsageError(f"object {self.name} has {len(self.rows)} rows", f"Give 1 to {MAX_ROWS}.")
        for row in self.rows:
            if not (np.isfinite(row.radius_m) and 0.01 <= row.radius_m <= MAX_RADIUS_M):
                raise UsageError(
                    f"object {self.name}: a row has a radius of {row.radius_m:g} m",
                    f"Give 0.01 to {MAX_RADIUS_M:g} m, in metres, not millimetres.",
                )
            if not (np.isfinite(row.height_m) and abs(row.height_m) <= MAX_HEIGHT_M):
                raise UsageError(
                    f"object {self.name}: a row has a height of {row.height_m:g} m",
                    f"Give up to {MAX_HEIGHT_M:g} m.",
                )

    def with_rows(self, count: int) -> TaggedObject:
        """The same object with its first rows only. Raises UsageError if it has fewer."""
        if not 1 <= count <= len(self.rows):
            raise UsageError(
                f"{self.name} has {len(self.rows)} rows, cannot use {count}", "Give fewer `rows`."
            )
        return TaggedObject(self.name, self.kind, self.rows[:count], self.label)


@cache
def builtin_objects() -> dict[str, TaggedObject]:
    """The built-in objects by name."""
    objects = {}
    for file in (resources.files("tagid.tags.layouts") / "data" / "objects").iterdir():
        if file.name.endswith(".toml"):
            data = parse_toml(file.read_bytes(), file.name)
            rows = tuple(Row(row["radius_m"], row["height_m"]) for row in data["rows"])
            objects[data["name"]] = TaggedObject(data["name"], data["kind"], rows, data["label"])
    return dict(sorted(objects.items()))


def object_named(name: str) -> TaggedObject:
    """A built-in object. Raises UsageError that lists the names if it is unknown."""
    objects = builtin_objects()
    if name not in objects:
        raise UsageError(
            f"unknown object {name[:80]!r}",
            f"Use {', '.join(objects)}, or give your own with `radius=METRES`.",
        )
    return objects[name]
