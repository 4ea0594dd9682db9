"""Stored calibration of a robot: its effective wheel base, measured with the radar.

The effective wheel base depends on tyres and floor by a few per cent, so it is stored for each robot.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from tagid.config import data_folder
from tagid.errors import ConfigError, DataError, FileFormatError
from tagid.files import make_folder, read_toml, write_bytes
from tagid.metadata import ResolvedMotion

_FILE: Final = "robots.toml"
_DIRECTIONS: Final = "directions.toml"
_MAX_BYTES: Final = 1 << 20
_LEAST_SIGMA: Final = 2e-3
"""Day-to-day variation of tyres and floor, which one recording does not show."""


@dataclass(frozen=True)
class Calibration:
    """An effective wheel base.

    Attributes:
        wheel_base_mm: value for which the odometry is correct.
        sigma: its relative standard deviation.
        turns: number of turns used.
    """

    wheel_base_mm: float
    sigma: float
    turns: float
    date_utc: str = ""

    def __post_init__(self) -> None:
        if not (100 <= self.wheel_base_mm <= 1000 and 0 < self.sigma < 0.5 and self.turns > 0):
            raise ConfigError(
                f"a wheel base of {self.wheel_base_mm} mm, sigma {self.sigma}, is not possible",
                "Calibrate again: tagid motion calibrate.",
            )


def wheel_base_from(resolved: ResolvedMotion) -> tuple[str, Calibration]:
    """Robot and wheel base from the resolved angles of a recording (`measured_angles`).

    The robot reported `radar_turn_in_own_rad` for a full turn, so its wheel base is larger by that ratio.

    Raises:
        DataError: the radar did not see the turn.
    """
    if not resolved.checked_by_radar:
        raise DataError(
            f"the radar did not see a full turn: {resolved.reason or 'no period'}",
            "Record at least two turns, with a strong reflector off the axis.",
        )
    turn, sigma = resolved.radar_turn_in_own_rad, resolved.radar_turn_sigma_rad
    base, robot, turns = resolved.wheel_base_mm, resolved.robot, resolved.turns
    if turn is None or sigma is None or base is None or robot is None or turns is None:
        raise DataError("the capture does not contain the motion of its robot", "Record it again.")
    return robot, Calibration(base * turn / (2 * math.pi), max(sigma / turn, _LEAST_SIGMA), turns)


def _load(path: Path) -> dict[str, Calibration]:
    try:
        tables = read_toml(path, _MAX_BYTES, missing_ok=True)
        return {name: Calibration(**table) for name, table in tables.items()}
    except (FileFormatError, TypeError):
        raise ConfigError(f"{path} is damaged", "Delete it and calibrate again.") from None


def _directions(path: Path) -> dict[str, bool]:
    """Whether each calibrated device turns opposite to its documents. Raises StorageError, ConfigError."""
    try:
        reversals = read_toml(path, _MAX_BYTES, missing_ok=True)
    except FileFormatError:
        reversals = {"": None}
    if not all(isinstance(value, bool) for value in reversals.values()):
        raise ConfigError(f"{path} is damaged", "Delete it and calibrate the direction again.")
    return reversals


def recall_reversed(device: str) -> bool:
    """Whether calibration found that a device turns opposite to its documents.

    Raises StorageError, ConfigError.
    """
    return _directions(data_folder() / _DIRECTIONS).get(device, False)


def remember_reversed(device: str, is_reversed: bool) -> Path:
    """Store the direction of a device; return the file. Raises StorageError, ConfigError."""
    path = data_folder() / _DIRECTIONS
    return _write(path, {**_directions(path), device: is_reversed})  # a damaged file is not overwritten


def recall(robot: str) -> Calibration | None:
    """The stored calibration of a robot; None if there is none. Raises ConfigError, StorageError."""
    return _load(data_folder() / _FILE).get(robot)


def remember(robot: str, calibration: Calibration) -> Path:
    """Store a robot's calibration; return the file. Raises StorageError."""
    path = data_folder() / _FILE
    stamp = datetime.now(UTC).isoformat(timespec="seconds")
    known = {**_load(path), robot: replace(calibration, date_utc=stamp)}
    return _write(path, {name: asdict(entry) for name, entry in sorted(known.items())})


def _write(path: Path, document: dict[str, Any]) -> Path:
    import tomli_w

    make_folder(path.parent)
    write_bytes(path, tomli_w.dumps(document).encode())
    return path
