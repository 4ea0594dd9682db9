"""Absurd numbers for every numeric option of every command, each with the cheapest other arguments."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer.main

FLOATS = ("0", "-1", "nan", "inf", "-inf", "1e300", "1e-300")
INTEGERS = ("0", "-1", "9" * 60)
IMPOSSIBLE = ("nan", "inf", "-inf", "1e300", "9" * 60)
"""Numbers that no option accepts."""

CAPTURE, DEVICE = "c.tagid.h5", "comxim+serial:///dev/ttyNOWHERE"
CHEAPEST: dict[str, tuple[str, ...]] = {
    "scan": ("--radar", "udp://127.0.0.1:9", "--axis-distance", "1", "--motion", "free?rpm=60"),
    "station": ("--bind", "nowhere"),
    "identify": (CAPTURE,),
    "enroll": ("new", "--point", "0.1,0", "--point=-0.05,0.08", "--point=0,-0.09", "--dry-run"),
    "report": (CAPTURE, "--method", "bp", "--out", "rep"),
    "reconstruct": (CAPTURE, "--method", "bp"),
    "join": (CAPTURE, "other.tagid.h5", "--out", "joined.tagid.h5", "--force"),
    "show": (CAPTURE,),
    "import": ("bare.npz", "--out", "imported.h5", "--force"),
    "export": (CAPTURE, "--out", "e.npz", "--force"),
    "simulate": ("points-3", "--views", "12", "--out", "s.tagid.h5", "--force"),
    "layouts design": ("--object", "mug", "--count", "2", "--reflectors", "3"),
    "layouts capacity": ("--object", "mug", "--reflectors", "3"),
    "layouts reflector": ("--out", "r.svg", "--force"),
    "layouts show": ("helmet-120", "--template", "t.svg"),
    "radar config": ("--radar", "udp://127.0.0.1:9"),
    "radar monitor": ("--radar", "udp://127.0.0.1:9"),
    "radar record": ("--radar", "udp://127.0.0.1:9", "--axis-distance", "1"),
    "radar calibrate": ("--radar", "udp://127.0.0.1:9", "--axis-distance", "1", "--distance", "1"),
    "radar reboot": ("--radar", "udp://127.0.0.1:9"),
    "motion find": ("--no-ble",),
    "motion spin": (DEVICE, "--yes"),
    "motion calibrate": ("--motion", DEVICE, "--radar", "udp://127.0.0.1:9", "--yes"),
}
PARTNERS = {
    ("config", "--cable-delay"): ("--start", "1"),
    ("reconstruct", "--levels"): ("--volume", "--heights=-0.1,0.1"),
}
"""Options that an option of a command needs to have an effect."""
SERVING = "emulate"
"""Commands that run until they are stopped: they get impossible numbers only."""
SETTINGS = ("occlusion", "aspect_harmonics", "wobble_harmonics", "levels", "finest_m", "l1", "steps", "width")


@dataclass(frozen=True)
class Case:
    """A command with an absurd number; `words` is its whole command line."""

    option: str
    value: str
    words: tuple[str, ...]


def cases() -> Iterator[Case]:
    """All of them, in the order of the commands."""
    yield from _of(typer.main.get_group(_app()), ())
    for name in SETTINGS:
        for value in (*FLOATS, INTEGERS[-1]):
            words = ("reconstruct", CAPTURE, "--method", "ats", "--pixels", "16", "--ats", f"{name}={value}")
            yield Case(f"--ats {name}", value, words)


def _app() -> typer.Typer:
    from tagid.cli.app import app

    return app


def _of(command: Any, words: tuple[str, ...]) -> Iterator[Case]:
    if hasattr(command, "list_commands"):
        for name in command.list_commands(None):
            yield from _of(command.get_command(None, name), (*words, name))
    for parameter in command.params:
        kind = parameter.type.name
        values = FLOATS if "float" in kind else INTEGERS if "int" in kind and not parameter.count else ()
        option = max(parameter.opts, key=len)
        for value in values:
            if words[0] == SERVING and (value not in IMPOSSIBLE or "seed" in option):
                continue
            cheapest = CHEAPEST.get(" ".join(words), ())
            if option in cheapest:
                at = cheapest.index(option)
                cheapest = cheapest[:at] + cheapest[at + 2 :]
            yield Case(
                option,
                value,
                (
                    *words,
                    *cheapest,
                    *PARTNERS.get(option, ()) * (option != "--cable-delay" or words[-1] == "config"),
                    f"{option}={value}",
                ),
            )


def prepare(folder: Path) -> None:
    """Write the captures that the commands read."""
    from dataclasses import replace

    import numpy as np

    from tagid.simulate import Acquisition, simulate_capture
    from tagid.simulate.presets import scene_from_layout
    from tagid.storage.hdf5 import write_capture

    positions = np.array([[0.1, 0.0], [-0.05, 0.08], [0.0, -0.09]])
    capture, _ = simulate_capture(scene_from_layout(positions, seed=1), Acquisition(snr_db=20, views=36), 1)
    write_capture(folder / CAPTURE, capture)
    write_capture(folder / "other.tagid.h5", replace(capture, antenna_height_m=0.1))
    np.savez(
        folder / "bare.npz",
        samples=capture.samples,
        range_start_m=capture.range_start_m,
        range_step_m=capture.range_step_m,
        angles_rad=capture.angles_rad,
        axis_distance_m=1.0,
    )


def fault(case: Case, done: subprocess.CompletedProcess[str] | None) -> str:
    """What is wrong with how a command ended, "" if nothing is; None: it was still running at its limit."""
    if done is None:
        return "no end"
    text = done.stdout + done.stderr
    for word in ("bug in tagid", "Traceback", "Warning", "fault in tagid"):
        if word in text:
            return f"{word}: {text.strip().splitlines()[0][:150]}"
    if done.returncode not in (0, 1, 2, 3, 4):
        return f"exit code {done.returncode}"
    if case.value in IMPOSSIBLE and "seed" not in case.option and done.returncode not in (1, 2):
        return f"accepted, exit code {done.returncode}"
    return ""
