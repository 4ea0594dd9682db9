"""Enrollment at the station, on simulated captures: disagreement, conflict, undo, full disk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.enrolling.registry import Registry
from tagid.errors import LayoutConflictError, TagidError, UsageError
from tagid.pipeline.answer import Identification
from tagid.pipeline.enrollment import LayoutProposal
from tagid.pipeline.prepared import prepare
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate import (
    Acquisition,
    Placement,
    parse_body,
    parse_reflector,
    scene_on_body,
    simulate_capture,
)
from tagid.station.enrolling import MOST, Enrolling, EnrolmentState, Subject, Taken
from tagid.station.errors import EnrolmentError
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tests.unit.storage_samples import file_size_limit

MINE = Layout("mine", np.array([(0.11, 0.0), (-0.02, 0.09), (-0.05, -0.07)]))
POSES = ((0.006, -0.002, 10.0), (-0.004, 0.005, 130.0), (0.001, 0.008, 250.0))


def capture(layout: Layout, pose: Sequence[float]):
    body, reflector = parse_body("none"), parse_reflector("octahedron")
    scene = scene_on_body(layout.name, body, reflector, 1, layouts={layout.name: layout})
    x, y, turn = pose
    acquisition = Acquisition(views=36, snr_db=20.0, placement=Placement((x, y), math.radians(turn)))
    return prepare(simulate_capture(scene, acquisition, seed=int(turn))[0])


@pytest.fixture(scope="module")
def captures():
    """Three captures of an object that is not enrolled, and one of helmet-120."""
    other = capture(builtin_layouts()["helmet-120"], POSES[1])
    return [*(capture(MINE, pose) for pose in POSES), other]


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return Registry(tmp_path / "registry.sqlite")


@pytest.fixture
def enrolling(registry: Registry) -> Enrolling:
    return Enrolling(lambda: registry, ImagingSettings)


def add(enrolling: Enrolling, *captures) -> EnrolmentState:
    for item in captures:
        enrolling.expect()[1](Path("a.tagid.h5"), item, Identification("unknown", None, item.uuid, None))
    return enrolling.state


def test_a_capture_of_another_object_is_named_and_replaced(
    enrolling: Enrolling, registry: Registry, captures
) -> None:
    first, second, third, other = captures
    with pytest.raises(EnrolmentError):
        enrolling.expect()
    with pytest.raises(TagidError, match="already enrolled"):
        enrolling.describe(Subject("helmet-120"))
    assert enrolling.state.subject is None
    enrolling.describe(Subject("gate-4", "helmet", "The blue one"))
    assert enrolling.expect()[0] == "enrolling gate-4, capture 1"
    assert "no majority" in str(add(enrolling, first, other).trouble)
    state = add(enrolling, second)
    assert str(state.trouble).startswith("capture 2 has a reflector") and state.proposal is None
    for wrong in (0, 7):
        with pytest.raises(EnrolmentError, match="no capture"):
            enrolling.drop(wrong)
    with pytest.raises(EnrolmentError, match="not ready"):
        enrolling.store()
    enrolling.drop(2)
    assert enrolling.state.trouble is None
    state = add(enrolling, third)
    assert [capture.number for capture in state.captures] == [1, 3, 4] and not state.measuring
    assert isinstance(state.proposal, LayoutProposal)
    assert (state.proposal.layout.kind, state.proposal.layout.label) == ("helmet", "The blue one")
    # Renaming keeps the captures; ending stores nothing.
    enrolling.describe(Subject("gate-5"))
    assert isinstance(enrolling.state.proposal, LayoutProposal)
    assert enrolling.state.proposal.layout.name == "gate-5"
    enrolling.cancel()
    assert enrolling.state.subject is None and enrolling.state.captures == ()
    assert {"gate-4", "gate-5"}.isdisjoint(layout.name for layout in registry.layouts())


def test_a_capture_belongs_to_the_enrolment_that_it_was_recorded_for(enrolling: Enrolling, captures) -> None:
    """An operator may end an enrollment and begin another while a capture is being recorded."""
    unread = Identification("unknown", None, captures[0].uuid, None)
    enrolling.describe(Subject("gate-4"))
    _, late = enrolling.expect()
    enrolling.describe(Subject("gate-5"))  # only a new name
    late(Path("a.tagid.h5"), captures[0], unread)
    assert [capture.number for capture in enrolling.state.captures] == [1]
    _, late = enrolling.expect()
    enrolling.cancel()
    late(Path("b.tagid.h5"), captures[1], unread)
    assert enrolling.state.subject is None and enrolling.state.captures == ()
    enrolling.describe(Subject("gate-6"))
    late(Path("b.tagid.h5"), captures[1], unread)
    assert enrolling.state.captures == () and not enrolling.state.measuring
    assert [capture.number for capture in add(enrolling, captures[1]).captures] == [1]


def test_an_object_that_is_enrolled_already_is_refused(
    enrolling: Enrolling, registry: Registry, captures
) -> None:
    registry.add(Layout("before", MINE.positions), "by hand")
    enrolling.describe(Subject("gate-4"))
    state = add(enrolling, *captures[:3])
    assert isinstance(state.trouble, LayoutConflictError) and "before" in state.trouble.message
    with pytest.raises(LayoutConflictError):
        enrolling.store()
    assert "gate-4" not in [layout.name for layout in registry.layouts()]
    assert enrolling.store(force=True).name == "gate-4"
    assert "gate-4" in [layout.name for layout in registry.layouts()]


def test_an_object_that_was_not_moved_is_noticed(enrolling: Enrolling, captures) -> None:
    enrolling.describe(Subject("gate-4"))
    x, y, turn = POSES[0]
    state = add(enrolling, captures[0], capture(MINE, (x, y, turn)))
    assert any(remark.startswith("capture 1 and capture 2 show") for remark in state.measured.remarks)
    enrolling.drop(2)
    state = add(enrolling, captures[1])
    assert not any("same place" in remark for remark in state.measured.remarks)


def test_undo_takes_back_its_own_enrolment_and_no_other(
    enrolling: Enrolling, registry: Registry, captures
) -> None:
    with pytest.raises(EnrolmentError):
        enrolling.undo()
    for again in (False, True):
        enrolling.describe(Subject("gate-4"))
        add(enrolling, *captures[:3])
        done = enrolling.store()
        assert (done.name, done.registry_version, done.has_layout) == ("gate-4", registry.version, True)
        assert registry.contents().signatures[0].name == "gate-4"
        if not again:
            enrolling.undo()
            assert enrolling.state.undone == "gate-4" and registry.contents().signatures == []
    before = registry.add(Layout("theirs", 1.3 * MINE.positions), "another program")
    with pytest.raises(EnrolmentError, match="changed since"):
        enrolling.undo()
    assert registry.version == before
    assert {"theirs", "gate-4"} <= {layout.name for layout in registry.layouts()}


def test_a_full_disk_stores_no_half_enrolment(enrolling: Enrolling, registry: Registry, captures) -> None:
    enrolling.describe(Subject("gate-4"))
    add(enrolling, *captures[:3])
    before = registry.version
    with file_size_limit(1000), pytest.raises(TagidError) as refused:
        enrolling.store()
    assert refused.value.remedy and registry.version == before
    state = enrolling.state
    assert state.proposal is not None and len(state.captures) == 3, "nothing has to be recorded again"
    enrolling.store()


def test_a_bad_name_kind_or_label_is_refused_at_once() -> None:
    for name, kind, label in (("Gate 4", "other", ""), ("../x", "other", ""), ("", "other", ""),
                              ("x", "cup", ""), ("x", "other", "=1+1")):  # fmt: skip
        with pytest.raises(UsageError):
            Subject(name, kind, label)


def test_an_enrolment_has_a_most_of_captures(enrolling: Enrolling) -> None:
    """Each keeps its scans in memory."""
    enrolling.describe(Subject("gate-4"))
    taken = Taken(1, Path("a.tagid.h5"), Identification("unknown", None, None, None), None)
    enrolling.state = replace(enrolling.state, captures=(taken,) * (MOST - 1))
    assert enrolling.expect()
    enrolling.state = replace(enrolling.state, captures=(taken,) * MOST)
    with pytest.raises(EnrolmentError, match=f"{MOST} captures"):
        enrolling.expect()
