"""An emulated rig of which link, empty room and reference target are measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tagid.commissioning.bench import Bench
from tagid.commissioning.rows import Level, StepReport
from tagid.commissioning.steps import run_step, step_named

SCENES = {"link": "empty", "room": "empty", "target": "target"}
"""What stands there at every step."""


@contextmanager
def measured_rig(folder: Path, bench: Callable[[str], Bench]) -> Iterator[tuple[Bench, StepReport]]:
    """The bench of the target and its report, with all kept in a folder.

    Args:
        bench: gives that of a scene.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TAGID_DATA", str(folder))
        patch.setenv("TAGID_CONFIG", str(folder / "config.toml"))
        for name, scene in SCENES.items():
            stand = bench(scene)
            report = run_step(step_named(name), stand)
            assert report.passed, [row for row in report.rows if row.level is Level.FAIL]
        yield stand, report
