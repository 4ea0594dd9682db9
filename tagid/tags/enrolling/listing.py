"""The enrolled layouts as a list for people, read without numerics: `tagid layouts` answers at once.

Only a registry in perfect order is read here. Of anything else this returns None, and the registry itself,
which checks every field, says what is wrong.
"""

from __future__ import annotations

import json
import math
import sqlite3
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

_APPLICATION_ID = 0x74616764
_SCHEMA_VERSION = 2
"""As in `tagid.tags.enrolling.registry`; a test compares them."""
_LEAST_SPACING_M = 0.02
_MOST = 16


@dataclass(frozen=True)
class Listed:
    """One line of the list.

    Attributes:
        definition: the layout as plain JSON values, as `Layout.to_dict` gives it.
        reflectors: their number. radius_m: largest distance from the axis, m.
    """

    definition: dict[str, Any]
    reflectors: int
    radius_m: float


def list_layouts(path: Path) -> tuple[int, list[Listed]] | None:
    """The registry's version and its layouts by name; None where the registry has to be opened itself."""
    if not path.is_file():
        return None
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        try:
            header = [connection.execute(f"PRAGMA {name}").fetchone()[0] for name in _HEADER]
            if header != [_APPLICATION_ID, _SCHEMA_VERSION]:
                return None
            connection.execute("BEGIN")
            version = int(connection.execute("SELECT COALESCE(MAX(version), 0) FROM change").fetchone()[0])
            rows = connection.execute("SELECT name, definition FROM layout ORDER BY name").fetchall()
        finally:
            connection.close()
        return version, [_listed(name, text) for name, text in rows]
    except (sqlite3.Error, ValueError, TypeError, KeyError, RecursionError, OSError):
        return None


_HEADER = ("application_id", "user_version")


def _listed(name: str, text: str) -> Listed:
    definition = json.loads(text)
    places = [(float(x), float(y)) for x, y in definition["positions_m"]]
    distinct = all(math.dist(a, b) >= _LEAST_SPACING_M for a, b in combinations(places, 2))
    radius = max(math.hypot(x, y) for x, y in places)
    texts = all(isinstance(definition[key], str) for key in ("kind", "label", "notes"))
    symmetry = definition["symmetry"]
    whole = isinstance(symmetry, int) and 1 <= symmetry <= len(places) <= _MOST
    if definition["name"] != name or not (len(places) >= 2 and distinct and radius <= 1 and texts and whole):
        raise ValueError("not in perfect order")
    return Listed(definition, len(places), radius)
