"""What the commands of `tagid radar` share: the radar that is meant, opened as the configuration says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tagid.config import Config
from tagid.errors import ConfigError

if TYPE_CHECKING:
    from tagid.radar.p440 import P440


def radar_url(config: Config) -> str:
    """The configured radar. Raises ConfigError if none is."""
    if not config["radar.url"]:
        raise ConfigError(
            "no radar is configured",
            "Give --radar udp://192.168.1.100 or serial:///dev/ttyACM0; `tagid radar find` looks for radars, "
            "and `tagid config set radar.url URL` keeps one.",
        )
    return str(config["radar.url"])


def open_configured(config: Config) -> P440:
    """The client of the configured radar, not connected yet. Raises ConfigError, UsageError, DeviceError."""
    from tagid.recording.radars import open_radar

    return open_radar(radar_url(config), config["radar.timeout_s"])
