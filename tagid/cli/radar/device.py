"""Shared by the commands of `tagid radar`: the selected radar, opened as configured."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tagid.config import Config, radar_url

if TYPE_CHECKING:
    from tagid.radar.p440 import P440


def open_configured(config: Config) -> P440:
    """The client of the configured radar, not connected yet. Raises ConfigError, UsageError, DeviceError."""
    from tagid.recording.radars import open_radar

    return open_radar(radar_url(config), config["radar.timeout_s"])
