"""Changes of the configuration file, which is replaced as a whole; `tagid.config` reads it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tagid.config import SETTINGS, config_path, parse_value, read_file
from tagid.storage import atomic


def change_file(name: str, raw: Any | None) -> Path:
    """Set one setting in the file, or remove it where `raw` is None; returns the file's path.

    Raises as `change_settings` does.
    """
    return change_settings({name: raw})


def change_settings(changes: Mapping[str, Any | None]) -> Path:
    """Set several settings in the file at once, or remove those that are None; returns the file's path.

    Raises:
        ConfigError: a setting is unknown or out of range; the file is then unchanged.
        StorageError, DiskFullError: the file cannot be written; it is then unchanged.
    """
    path = config_path()
    known = {setting.name for setting in SETTINGS}
    found = read_file(path)
    for name, raw in changes.items():
        if raw is None and name in known:
            found.pop(name, None)
        else:
            found[name] = parse_value(name, raw, "command line")
    _write(path, found)
    return path


def _write(path: Path, found: Mapping[str, Any]) -> None:
    import tomli_w

    tables: dict[str, dict[str, Any]] = {}
    for name, value in sorted(found.items()):
        section, key = name.split(".", 1)
        tables.setdefault(section, {})[key] = value
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise atomic.storage_error(error, path, "making its folder") from error
    atomic.write_bytes(path, tomli_w.dumps(tables).encode())
