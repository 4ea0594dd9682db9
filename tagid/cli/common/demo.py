"""The demo's radar: an emulated P440 in its own process, reached over a real UDP socket on loopback."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tagid.errors import DeviceError
from tagid.metadata import ObjectInfo

DEMO_RPM = 6.0
DEMO_AXIS_DISTANCE_M = 1.0
DEMO_CENTRE = "0.005,-0.003"
"""Nobody puts an object exactly on the axis: it stands 6 mm off, body and all."""


@dataclass(frozen=True)
class Emulated:
    """An emulated radar that runs.

    Attributes:
        settings: for connecting to it, by the names of the configuration.
        object: what it shows, with its true pose.
    """

    settings: dict[str, Any]
    object: ObjectInfo


@contextmanager
def emulated_radar(scene: str) -> Iterator[Emulated]:
    """Run an emulator while the block runs; yields how to connect to it, and what it shows.

    Raises DeviceError with the emulator's message if it does not start.
    """
    arguments = ["emulate", "p440", "--bind", "127.0.0.1:0", "--scene", scene, "--rpm", str(DEMO_RPM)]
    arguments += ["--centre", DEMO_CENTRE]
    process = subprocess.Popen(
        [sys.executable, "-m", "tagid", *arguments, "--output", "json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        try:
            data = json.loads(line)["data"]
            url, shown = data["url"], data["object"]
        except (ValueError, KeyError, TypeError):
            rest, errors = process.communicate(timeout=5)
            raise DeviceError(
                f"the emulated radar did not start: {_reason(line + rest, errors)}",
                f"Run `tagid emulate p440 --scene {scene}` to see why.",
            ) from None
        settings = {
            "radar.url": url,
            "motion.url": f"free?rpm={DEMO_RPM:g}",
            "motion.axis_distance_m": DEMO_AXIS_DISTANCE_M,
        }
        yield Emulated(settings, ObjectInfo.from_json(shown))
    finally:
        process.terminate()
        try:
            process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _reason(output: str, errors: str) -> str:
    try:
        return str(json.loads(output)["errors"][0]["message"])
    except (ValueError, KeyError, IndexError, TypeError):
        return (errors.strip().splitlines() or ["no reason given"])[-1]
