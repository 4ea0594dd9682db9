"""Installs build and configuration on a board, and compares a board with a build.

main.py is removed first and written last, so that a board never starts an incomplete firmware.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from firmware_tools.board import CHIPS, Board, Python
from firmware_tools.bridge.tagid_bridge import settings
from firmware_tools.build import Build
from tagid.errors import ConfigError
from tagid.files import read_bytes

CONFIG: Final = settings.PATH
BONDS: Final = "bonds.json"
TRIES: Final = "tries.json"
_LARGEST: Final = 4096


def make_config(chip: str, given: Mapping[str, Any], path: Path | None = None) -> dict[str, Any]:
    """A complete configuration: the chip's pins, then a file's keys, then single keys.

    Args:
        chip: "esp32" or "esp32c3".
        given: keys that override; None values are omitted.
        path: a JSON file of keys.

    Raises:
        ConfigError: a key is unknown or out of bounds; the same rule as on the board.
        StorageError: the file cannot be read.
    """
    if chip not in CHIPS:
        raise ConfigError(f"there is no chip {chip!r}", f"Choose one of {', '.join(CHIPS)}.")
    keys: dict[str, Any] = {"name": "tagid-bridge", **CHIPS[chip].pins}
    where = "the configuration"
    if path is not None:
        where = str(path)
        try:
            read = json.loads(read_bytes(path, _LARGEST))
        except (ValueError, RecursionError) as error:
            raise ConfigError(
                f"{path}: is not JSON ({error})", "See docs/bridge.md for an example."
            ) from error
        if not isinstance(read, dict):
            raise ConfigError(f"{path}: is not a table of keys", "See docs/bridge.md for an example.")
        keys.update(read)
    keys.update({key: value for key, value in given.items() if value is not None})
    try:
        config = dict(settings.check(keys))
    except ValueError as error:
        raise ConfigError(f"{where}: {error}", "See docs/bridge.md for keys and bounds.") from error
    problem = CHIPS[chip].problem_of(config)
    if problem:
        raise ConfigError(f"{where}: {problem}", "See docs/bridge.md for the pins of each chip.")
    return config


def new_passkey() -> str:
    """Six random digits; never 000000, which some systems interpret as no pass-key."""
    return f"{secrets.randbelow(999_999) + 1:06d}"


@dataclass(frozen=True)
class Provisioned:
    """The files written, and the board."""

    python: Python
    written: list[str]
    kept: list[str]


def provision(
    board: Board, build: Build, config: dict[str, Any], progress: Callable[[float, str], None]
) -> Provisioned:
    """Write the files that differ, each checked by its hash, and restart the board.

    Raises DeviceError, DeviceRejectedError (MicroPython too old).
    """
    python = board.python()
    text = (json.dumps(config, indent=1) + "\n").encode()
    old, _ = _config_of(board)
    names = [*[name for name in build.files if name != "main.py"], CONFIG, "main.py"]
    contents = {**build.files, CONFIG: text}
    hashes = build.hashes
    kept = [name for name in build.files if board.hash_of(name) == hashes[name]]
    if old == config:
        kept.append(CONFIG)
    changed = [name for name in names if name not in kept]
    if changed and "main.py" in kept:
        kept.remove("main.py")
        changed.append("main.py")
    if changed:
        board.remove("main.py")
    # Computers that paired with an old pass-key must pair again with the new one. Their bonds are removed
    # first, so that no power cut leaves a board with both; the counted attempts are those of the old one.
    if old is None or old.get("passkey") != config["passkey"]:
        board.remove(BONDS)
        board.remove(TRIES)
    done = 0
    for name in changed:
        start = done
        board.write(name, contents[name], lambda count, start=start, name=name: progress(start + count, name))  # type: ignore[misc]
        done += len(contents[name])
    board.restart()
    return Provisioned(python, changed, kept)


def _config_of(board: Board) -> tuple[dict[str, Any] | None, str]:
    """The configuration on a board, or None and why there is no valid one."""
    data = board.read(CONFIG)
    if data is None:
        return None, "there is no configuration file"
    try:
        return dict(settings.check(json.loads(data))), ""
    except (ValueError, TypeError, RecursionError) as error:
        return None, str(error)


@dataclass(frozen=True)
class Comparison:
    """Comparison of a board with a build.

    Attributes:
        python: the board's MicroPython.
        files: "same", "differs" or "missing" for each file of the build.
        config: the configuration without its pass-key, or None.
        passkey: whether one is set.
        problem: why the configuration is not valid, or "".
    """

    python: Python
    files: dict[str, str]
    config: dict[str, Any] | None
    passkey: bool
    problem: str
    extra: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether everything is as built and the configuration is valid."""
        return not self.problem and set(self.files.values()) <= {"same"}


def compare(board: Board, build: Build, progress: Callable[[float, str], None]) -> Comparison:
    """Compare by hash. Raises DeviceError, DeviceRejectedError (MicroPython too old)."""
    python = board.python()
    files = {}
    for done, (name, digest) in enumerate(build.hashes.items()):
        progress(done, name)
        actual = board.hash_of(name)
        files[name] = "missing" if actual is None else "same" if actual == digest else "differs"
    config, problem = _config_of(board)
    passkey = config is not None and config.pop("passkey") is not None
    folder = (
        board.evaluate("__import__('os').listdir('tagid_bridge')") if "missing" not in files.values() else []
    )
    extra = [f"tagid_bridge/{name}" for name in folder if f"tagid_bridge/{name}" not in files]
    return Comparison(python, files, config, passkey, problem, extra)
