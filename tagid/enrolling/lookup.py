"""Layouts by name: those of a file, then those of the registry, then the built-in ones."""

from __future__ import annotations

from pathlib import Path

from tagid.enrolling.layout_file import read_entries
from tagid.enrolling.registry import Registry
from tagid.errors import UsageError
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.test_card import NAME as TEST_CARD
from tagid.tags.layouts.test_card import test_card


def named_layouts(file: Path | None, registry: Path) -> dict[str, Layout]:
    """Every layout that can be named, by name.

    Args:
        file: TOML or JSON file of layouts, e.g. of `tagid layouts design --out`; its layouts come first.
        registry: registry file; it is only read, and not made where it does not exist.

    Raises:
        RegistryError, StorageError, FileFormatError: a file cannot be read.
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
