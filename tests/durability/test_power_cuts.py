"""The short run of `power_cuts.py`: what was acknowledged is there after a power cut at any system call."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from power_cut_cases import recorded, unsynced
from power_cut_states import Density
from power_cuts import try_all
from syscalls import Recording, unavailable

WHY_NOT = unavailable()
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=f"needs to trace system calls: {WHY_NOT}")
DENSITY = {
    "radar record": Density(0, 20),
    "configuration": Density(1, 1),
    "registry": Density(0, 8),
}
"""Cases, and how many states of each."""


@dataclass(frozen=True)
class Traced:
    """A case, and the system calls that it made."""

    name: str
    recording: Recording


@pytest.fixture(scope="module", params=DENSITY)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Traced:
    return Traced(request.param, recorded(request.param, tmp_path_factory.mktemp("recorded")))


def test_nothing_acknowledged_is_lost_in_any_state(case: Traced, tmp_path: Path) -> None:
    outcomes = try_all(case.name, case.recording, tmp_path, DENSITY[case.name])
    total = outcomes.pop("")
    assert not outcomes, outcomes.most_common(5)
    assert total > 10, "states without a fault"


@pytest.mark.parametrize("kind", ["files", "folders"])
def test_the_states_show_what_a_missing_sync_loses(case: Traced, kind: str, tmp_path: Path) -> None:
    outcomes = try_all(case.name, unsynced(case.recording, kind), tmp_path, Density(0, 20), first=True)
    assert sum(outcomes.values()) > outcomes[""], f"no state shows that {kind} are not synced"
