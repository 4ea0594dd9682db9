"""Reflectors at several heights, from several antenna heights and from one."""

from __future__ import annotations

import numpy as np
import pytest
from reader_scenes import prepared

from tagid.capture import Capture
from tagid.geometry import Aperture
from tagid.reading.decision import Decision, decide
from tagid.reading.reader import contest
from tagid.reading.transfers.plain import BARE
from tagid.tags.layouts.layout import Layout
from tests.unit.heights_scenes import DOWN, FLAT, OTHER, PLAN, UP, scan
from tests.unit.imaging_scenes import record, turn

SEVERAL = (0.0, 0.2)
VIEWS = 20
STRANGER = Layout("stranger", PLAN, heights=np.array([0.06, 0.06, 0.0]))


def read(layout: Layout, heights: tuple[float, ...], raised: float) -> Decision:
    return decided(scan(layout, heights, raised, VIEWS))


def decided(capture: Capture) -> Decision:
    base = contest(prepared(capture), [UP, DOWN, OTHER, FLAT])
    base.transfers, base.sheets = (BARE,), ()
    return decide(base.run())


@pytest.mark.parametrize(("layout", "raised"), [(FLAT, 0.05), (OTHER, -0.04)])
def test_a_layout_is_named_wherever_its_plane_lies(layout: Layout, raised: float) -> None:
    decision = read(layout, SEVERAL, raised)
    assert decision.name == layout.name
    model, x = decision.best.estimate.model, decision.best.estimate.x
    assert model.heights_of(x)[0] == pytest.approx(np.asarray(layout.heights) + raised, abs=0.01)


def test_a_path_that_rises_from_view_to_view_is_read() -> None:
    """No height has a second view: the mean of all is subtracted, not that of each."""
    antennas = turn(24, 1.0).positions
    rising = Aperture(antennas + np.outer(np.linspace(0.0, 0.3, len(antennas)), [0, 0, 1]))
    points = np.column_stack([DOWN.positions, np.asarray(DOWN.heights) + 0.02])
    recorded = record(points, [1, 1, 1], rising, start_m=0.5, noise=0.1)
    assert decided(recorded).name == DOWN.name


@pytest.mark.parametrize(("heights", "raised"), [(SEVERAL, 0.05), ((0.2,), 0.05)])
def test_a_stranger_that_differs_in_height_alone_is_not_named(
    heights: tuple[float, ...], raised: float
) -> None:
    assert read(STRANGER, heights, raised).name is None


@pytest.mark.parametrize(("layout", "height", "raised"), [(FLAT, 0.0, 0.05), (UP, 0.2, 0.05)])
def test_from_one_height_no_name_is_wrong(layout: Layout, height: float, raised: float) -> None:
    decision = read(layout, (height,), raised)
    assert decision.name in (None, layout.name)
    if not height:
        assert decision.status == "ambiguous"
