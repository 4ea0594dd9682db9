"""Virtual Bluetooth from a provider: the firmware tools register one through an entry point.

The package imports none of those tools; they register in the group `tagid.virtual_bluetooth`.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import metadata
from typing import Any, Final

from tagid.errors import MissingExtraError

GROUP: Final = "tagid.virtual_bluetooth"
"""`backend`: open_backend(where, passkey) for bleak; `air`: a module with Air, HciServer and make_controller;
`board`: BoardProcess(config, uart), the bridge's firmware without a board."""


def virtual_bluetooth(part: str) -> Any:
    """A member of the group. Raises MissingExtraError if there is no provider, or it lacks its packages."""
    for entry in metadata.entry_points(group=GROUP, name=part):
        with suppress(ImportError):
            return entry.load()
    raise MissingExtraError(
        "this installation has no virtual Bluetooth controllers",
        "In a checkout of tagid: pip install ./firmware_tools",
    )
