"""Layout files for editing and exchange: TOML, one or more layouts.

Export and import are a round trip; every field of a file is checked before use.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tagid.errors import FileFormatError, TagidError
from tagid.files import read_bytes, write_bytes
from tagid.tags.layouts.layout import Layout, layout_from_dict, read_layout

FORMAT = "tagid.layouts"
VERSION = 1
MAX_BYTES = 4 << 20
MAX_LAYOUTS = 2000


def layouts_to_toml(layouts: Sequence[Layout]) -> str:
    """TOML text of layouts; `read_layouts` reads it."""
    import tomli_w

    tables: list[dict[str, Any]] = []
    for layout in layouts:
        tables.append({key: value for key, value in layout.to_dict().items() if value != ""})
    return tomli_w.dumps({"format": FORMAT, "version": VERSION, "layout": tables})


def write_layouts(layouts: Sequence[Layout], path: Path) -> None:
    """Write a file of layouts atomically. Raises StorageError."""
    write_bytes(path, layouts_to_toml(layouts).encode("utf-8"))


def read_layouts(path: Path) -> list[Layout]:
    """Layouts of a .toml file written by `write_layouts`, or the one of a .toml or .json file.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not such a file, a newer version, a wrong field or a name used twice.
    """
    if path.suffix.lower() == ".json":
        return [read_layout(path)]
    raw = read_bytes(path, MAX_BYTES)
    try:
        data = tomllib.loads(raw.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} is not TOML: {str(error)[:200]}", "Export layouts with `tagid layouts export`."
        ) from None
    if not data:
        raise FileFormatError(f"{path} is empty", "Export layouts with `tagid layouts export`.")
    if "format" not in data and "layout" not in data:
        return [read_layout(path)]
    version = data.get("version")
    if data.get("format") != FORMAT or isinstance(version, bool) or not isinstance(version, int):
        raise FileFormatError(
            f"{path}: format is {str(data.get('format'))[:80]!r}, expected {FORMAT!r} with a version",
            "Export layouts with `tagid layouts export`.",
        )
    if version > VERSION:
        raise FileFormatError(
            f"{path} has version {version}, this tagid supports up to {VERSION}",
            "Use the newer tagid that wrote it.",
        )
    tables = data.get("layout")
    if not isinstance(tables, list) or not 1 <= len(tables) <= MAX_LAYOUTS:
        raise FileFormatError(f"{path} holds no [[layout]] tables", f"Give 1 to {MAX_LAYOUTS} layouts.")
    found: dict[str, Layout] = {}
    for number, table in enumerate(tables, 1):
        try:
            layout = layout_from_dict(table)
        except TagidError as error:
            raise FileFormatError(f"{path}, layout {number}: {error.message}", error.remedy) from error
        if layout.name in found:
            raise FileFormatError(f"{path}: the name {layout.name} occurs twice", "Rename one of them.")
        found[layout.name] = layout
    return list(found.values())
