"""One answer from several recordings: what is weak alone, what is noise, and what is no enrolled tag."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from bodies_synthetic import Thing, capture, ring

from tagid.errors import DataError
from tagid.pipeline.answer import Identification
from tagid.pipeline.identify import identify_together
from tagid.reading.verdict import Code
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = builtin_layouts()
HELMET = Thing(tuple(complex(x, y) for x, y in LAYOUTS["helmet-120"].positions), (1.0, 1.0, 1.0))


@cache
def together(things: tuple[Thing, ...], noise: float) -> tuple[Identification, list[Identification]]:
    """Recordings of things, each in another place and turn."""
    rng = np.random.default_rng(7)
    captures = [
        capture(
            thing,
            seed,
            centre=complex(*rng.uniform(-0.005, 0.005, 2)),
            rotation=float(rng.uniform(0, 6)),
            views=24,
            noise=noise,
        )
        for seed, thing in enumerate(things)
    ]
    return identify_together(captures, list(LAYOUTS.values()), registry_version=3)


def test_recordings_together_say_more_than_each_alone() -> None:
    joint, alone = together((HELMET,) * 3, 2.3)
    assert (joint.status, joint.label) == ("identified", LAYOUTS["helmet-120"].label)
    assert joint.reading is not None and joint.reading.layout == "helmet-120"
    # Of one of them a tag elsewhere is as likely.
    assert "unknown" in [design.status for design in alone]
    leads = [design.reading.lead for design in alone if design.reading is not None]
    assert joint.reading.lead > 1.5 * max(leads) and joint.reading.bound is not None
    assert (joint.capture_uuid, joint.registry_version) == (None, 3)


def test_recordings_of_two_objects_are_not_named_together() -> None:
    joint, alone = together((HELMET, ring(0, 90)), 0.3)
    names = [design.reading.layout for design in alone if design.reading is not None]
    assert names == ["helmet-120", "container-90"]
    assert joint.reading is not None
    assert (joint.status, joint.reading.code) == ("unknown", Code.DISAGREE)


def test_one_recording_reads_as_alone_and_none_is_refused() -> None:
    joint, (alone,) = together((ring(0, 90),), 0.3)
    assert joint.reading is not None and alone.reading is not None
    assert joint.reading.layout == alone.reading.layout == "container-90"
    assert joint.reading.lead == alone.reading.lead
    assert joint.capture_uuid == alone.capture_uuid is not None
    with pytest.raises(DataError, match="recordings"):
        identify_together([], list(LAYOUTS.values()))
