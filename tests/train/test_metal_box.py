"""The reader's sheet of metal against a box solved by cells, alone and with another object beside it."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.constants import SPEED_OF_LIGHT
from tagid.fields.thin_shell import BoxShell, ShellField
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.reading.decision import decide
from tagid.reading.reader import contest
from tagid.reading.sheet import METAL_M, OBLIQUITIES
from tagid.tags.layouts.layout import builtin_layouts
from train.population import draw
from train.volume import box, echo, metal


@pytest.mark.parametrize("half_m", [(0.0286, 0.0173), (0.035, 0.035), (0.06, 0.045)])
def test_a_sheet_of_metal_returns_what_a_solved_box_does(half_m: tuple[float, float]) -> None:
    k = np.linspace(3.1e9, 4.8e9, 5) * 2 * np.pi / SPEED_OF_LIGHT
    antenna = np.exp(2j * np.pi * np.arange(72) / 72)
    solved = echo(metal(box(*half_m)), k * SPEED_OF_LIGHT / (2 * np.pi), antenna)
    solved = solved * np.exp(-2j * k)[:, None]
    columns = ShellField.of(k, BoxShell(*half_m, METAL_M), 48).seen_from(antenna).echoes(OBLIQUITIES)
    remaining = [
        base - rows.T @ np.linalg.lstsq(rows.T, base, rcond=None)[0]
        for base, rows in zip(solved, columns, strict=True)
    ]
    moving = solved - solved.mean(axis=1, keepdims=True)
    assert (np.abs(remaining) ** 2).sum() < 1e-3 * (np.abs(moving) ** 2).sum()


def test_a_box_with_another_object_beside_it_is_no_tag() -> None:
    """With odd scatterers in the field of the box alone it was a pair on a filled vessel, by 10 nats."""
    specimen = draw(320237, views=12)
    assert (specimen.body, specimen.clutter, len(specimen.positions)) == ("box", "second", 0)
    scans = preprocess(specimen.capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    decision = decide(contest(scans, list(builtin_layouts().values())).run())
    assert decision.status == "no_tag" and "a box of metal" in decision.reason and decision.lead < -9
