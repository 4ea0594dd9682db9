"""Layout files that people edit and exchange: TOML with one or more layouts and, optionally, signatures.

Exporting and importing preserves every value. Every field of a file is validated before it is used. Layouts
are looked up by name in such a file, then in the registry, then among the built-in ones.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tagid.enrolling.registry import Registry
from tagid.errors import FileFormatError, TagidError, UsageError
from tagid.files import read_toml, write_bytes
from tagid.tags.bodies.signature import Signature
from tagid.tags.bodies.signature_file import MAX_BYTES as MAX_SIGNATURE_BYTES
from tagid.tags.bodies.signature_file import from_bytes, to_bytes
from tagid.tags.layouts.layout import Layout, builtin_layouts, layout_from_dict, read_layout
from tagid.tags.layouts.test_card import NAME as TEST_CARD
from tagid.tags.layouts.test_card import test_card

FORMAT = "tagid.layouts"
VERSION = 2
"""Version 2 may contain signatures of bodies and objects; a file without signatures is written as version
1."""
MAX_BYTES = 16 << 20
MAX_LAYOUTS = 2000
MAX_SIGNATURES = 200
_EXPORT = "Export layouts with `tagid layouts export`."


@dataclass(frozen=True)
class Entries:
    """Contents of a layout file.

    Attributes:
        layouts: with unique names.
        signatures: with unique pairs of kind and name.
    """

    layouts: tuple[Layout, ...]
    signatures: tuple[Signature, ...] = ()


def layouts_to_toml(layouts: Sequence[Layout], signatures: Sequence[Signature] = ()) -> str:
    """TOML text of layouts and signatures, as read by `read_entries`."""
    import tomli_w

    tables = [{key: value for key, value in layout.to_dict().items() if value != ""} for layout in layouts]
    data: dict[str, Any] = {"format": FORMAT, "version": VERSION if signatures else 1, "layout": tables}
    if signatures:
        data["signature"] = [
            {
                "kind": signature.kind,
                "name": signature.name,
                "data": base64.b64encode(to_bytes(signature)).decode(),
            }
            for signature in signatures
        ]
    return tomli_w.dumps(data)


def write_layouts(layouts: Sequence[Layout], path: Path, signatures: Sequence[Signature] = ()) -> None:
    """Write layouts and signatures to a file, atomically. Raises StorageError."""
    write_bytes(path, layouts_to_toml(layouts, signatures).encode("utf-8"))


def read_layouts(path: Path) -> list[Layout]:
    """The layouts in a file; see `read_entries`."""
    return list(read_entries(path).layouts)


def read_entries(path: Path) -> Entries:
    """Entries of a .toml file written by `write_layouts`, or the single layout of a .toml or .json file.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not a layout file, a newer version, an invalid field or a duplicate name.
    """
    if path.suffix.lower() == ".json":
        return Entries((read_layout(path),))
    try:
        data = read_toml(path, MAX_BYTES)
    except FileFormatError as error:
        raise FileFormatError(error.message, _EXPORT) from None
    if not data:
        raise FileFormatError(f"{path} is empty", _EXPORT)
    if "format" not in data and "layout" not in data:
        return Entries((read_layout(path),))
    version = data.get("version")
    if data.get("format") != FORMAT or isinstance(version, bool) or not isinstance(version, int):
        raise FileFormatError(
            f"{path}: format is {str(data.get('format'))[:80]!r}, expected {FORMAT!r} with a version",
            _EXPORT,
        )
    if version > VERSION:
        raise FileFormatError(
            f"{path} has version {version}, this tagid reads up to {VERSION}",
            "Use the newer tagid that wrote it.",
        )
    signatures = _signatures(path, data.get("signature", []))
    tables = data.get("layout", [] if signatures else None)
    least = 0 if signatures else 1
    if not isinstance(tables, list) or not least <= len(tables) <= MAX_LAYOUTS:
        raise FileFormatError(f"{path} has no [[layout]] tables", f"Give 1 to {MAX_LAYOUTS} layouts.")
    layouts: dict[str, Layout] = {}
    for number, table in enumerate(tables, 1):
        try:
            layout = layout_from_dict(table)
        except TagidError as error:
            raise FileFormatError(f"{path}, layout {number}: {error.message}", error.remedy) from error
        if layout.name in layouts:
            raise FileFormatError(f"{path}: the name {layout.name} occurs twice", "Rename one of them.")
        layouts[layout.name] = layout
    return Entries(tuple(layouts.values()), signatures)


def _signatures(path: Path, tables: Any) -> tuple[Signature, ...]:
    """Signatures from the [[signature]] tables. Raises FileFormatError."""
    if not isinstance(tables, list) or len(tables) > MAX_SIGNATURES:
        raise FileFormatError(
            f"{path}: signature is not a list of up to {MAX_SIGNATURES} tables",
            _EXPORT,
        )
    signatures: dict[tuple[str, str], Signature] = {}
    for number, table in enumerate(tables, 1):
        where = f"{path}, signature {number}"
        text = table.get("data") if isinstance(table, dict) else None
        if not isinstance(text, str) or len(text) > 2 * MAX_SIGNATURE_BYTES:
            raise FileFormatError(f"{where} has no data", _EXPORT)
        try:
            data = base64.b64decode(text, validate=True)
        except (ValueError, binascii.Error):
            raise FileFormatError(f"{where} is not base64", _EXPORT) from None
        signature = from_bytes(data, where)
        if (signature.kind, signature.name) in signatures:
            raise FileFormatError(
                f"{path}: the {signature.kind} {signature.name} occurs twice", "Remove one of them."
            )
        signatures[signature.kind, signature.name] = signature
    return tuple(signatures.values())


def named_layouts(file: Path | None, registry: Path) -> dict[str, Layout]:
    """Every layout that can be named, by name: those of a TOML or JSON file first, e.g. of `tagid layouts
    design --out`.

    The registry file is only read, and not made where it does not exist. Raises RegistryError, StorageError,
    FileFormatError: a file cannot be read.
    """
    layouts = {**builtin_layouts(), TEST_CARD: test_card()}
    if registry.exists():
        layouts |= {layout.name: layout for layout in Registry(registry).layouts()}
    if file is not None:
        layouts |= {layout.name: layout for layout in read_entries(file).layouts}
    return layouts


def only_layout(file: Path) -> str:
    """Name of the layout of a file that holds one. Raises UsageError where it holds several or none."""
    names = [layout.name for layout in read_entries(file).layouts]
    if len(names) != 1:
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise UsageError(f"{file} holds {len(names)} layouts: {listed or 'none'}", "Name one of them.")
    return names[0]
