"""Every command line runs in a process of its own, with its own configuration and registry."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture
def home(tmp_path: Path) -> dict[str, str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TAGID_")}
    return {
        **environment,
        "TAGID_CONFIG": str(tmp_path / "config.toml"),
        "TAGID_DATA": str(tmp_path / "data"),
        "TAGID_RADAR_TIMEOUT_S": "0.5",
        "OMP_NUM_THREADS": "1",
    }
