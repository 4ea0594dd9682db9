"""Stations for the tests of them, closed with their clients after each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from remembered import shared

if TYPE_CHECKING:
    from tagid.station.server import Server


@pytest.fixture
def closed_clients() -> Iterator[None]:
    """Closes the WebSocket clients of a test after it."""
    from station_harness import Raw

    yield
    while Raw.opened:
        Raw.opened.pop().close()


@pytest.fixture
def serve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closed_clients: None, remembered: Path
) -> Iterator[Callable[..., Server]]:
    """Starts stations, see `station_harness.stations`; their reports remember what was read before."""
    from station_harness import stations

    for name, value in shared(remembered).items():
        monkeypatch.setenv(name, value)
    yield from stations(tmp_path, monkeypatch)
