"""The demo's radar: an emulated P440 in its own process, reached over a real UDP socket on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from tagid import processes
from tagid.errors import DeviceError, TagidError, UsageError
from tagid.metadata import ObjectInfo
from tagid.result import Problem

DEMO_RPM = 6.0
DEMO_AXIS_DISTANCE_M = 1.0
_REFUSAL_S = 5.0
_HEIGHT_BYTES = 40
"""Every height is written over the whole of the one before."""
DEMO_CENTRE = "0.005,-0.003"
"""Objects are never exactly on the axis: object and body are 6 mm off."""


@dataclass(frozen=True)
class Emulated:
    """A running emulated radar.

    Attributes:
        settings: connection settings, by their configuration names.
        object: the emulated object, with its true pose.
        place: moves the emulated antenna to a height above the object's plane, m.
    """

    settings: dict[str, Any]
    object: ObjectInfo
    place: Callable[[float], None]


@contextmanager
def emulated_radar(scene: str) -> Iterator[Emulated]:
    """Run an emulator while the block runs; yields the connection settings and the emulated object.

    Raises UsageError with the emulator's message if the scene is unknown, DeviceError if it does not start.
    """
    # A file without a name: nothing of it stays, however this process ends.
    with tempfile.TemporaryFile() as height_file:
        yield from _emulated(scene, height_file.fileno())


def _emulated(scene: str, height_file: int) -> Iterator[Emulated]:
    def place(height_m: float) -> None:
        os.pwrite(height_file, f"{height_m!r}\n".ljust(_HEIGHT_BYTES).encode(), 0)

    place(0.0)
    arguments = ["emulate", "p440", "--bind", "127.0.0.1:0", "--scene", scene, "--rpm", str(DEMO_RPM)]
    arguments += ["--centre", DEMO_CENTRE, "--antenna-height-file", f"/dev/fd/{height_file}"]
    # Without a buffer: what is read ahead of the first line would be lost to `communicate`.
    process = processes.start(
        "tagid",
        *arguments,
        "--output",
        "json",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        pass_fds=(height_file,),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        try:
            data = json.loads(line)["data"]
            url, shown = data["url"], data["object"]
        except (ValueError, KeyError, TypeError):
            with suppress(subprocess.TimeoutExpired):  # `communicate` would close its input, which ends it
                process.wait(_REFUSAL_S)
            rest, errors = process.communicate()
            raise _refusal(scene, (line + rest).decode(), errors.decode()) from None
        settings = {
            "radar.url": url,
            "motion.url": f"free?rpm={DEMO_RPM:g}",
            "motion.axis_distance_m": DEMO_AXIS_DISTANCE_M,
        }
        yield Emulated(settings, ObjectInfo.from_json(shown), place)
    finally:
        process.terminate()
        try:
            process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _refusal(scene: str, output: str, errors: str) -> TagidError:
    """The error of an emulator that did not start: UsageError if it refuses the scene, else DeviceError."""
    try:
        (error,) = json.loads(output)["errors"]
        problem = Problem.from_json(error)
        kind = UsageError if problem.code == UsageError.code else DeviceError
        return kind(f"the emulated radar did not start: {problem.message}", problem.remedy)
    except (ValueError, KeyError, TypeError):
        reason = (errors.strip().splitlines() or ["no reason given"])[-1]
        return DeviceError(
            f"the emulated radar did not start: {reason}",
            f"Run `tagid emulate p440 --scene {scene}` to see why.",
        )
