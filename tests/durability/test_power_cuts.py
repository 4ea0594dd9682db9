"""The short run of `power_cuts.py`: what was acknowledged is there after a power cut at any system call."""

from __future__ import annotations

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


@pytest.fixture(scope="module", params=DENSITY)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Recording]:
    return request.param, recorded(request.param, tmp_path_factory.mktemp("recorded"))


def test_nothing_acknowledged_is_lost_in_any_state(case: tuple[str, Recording], tmp_path: Path) -> None:
    outcomes = try_all(*case, tmp_path, DENSITY[case[0]])
    total = outcomes.pop("")
    assert not outcomes, outcomes.most_common(5)
    assert total > 10, "states without a fault"


@pytest.mark.parametrize("kind", ["files", "folders"])
def test_the_states_show_what_a_missing_sync_loses(
    case: tuple[str, Recording], kind: str, tmp_path: Path
) -> None:
    name, recording = case
    outcomes = try_all(name, unsynced(recording, kind), tmp_path, Density(0, 20), first=True)
    assert sum(outcomes.values()) > outcomes[""], f"no state shows that {kind} are not synced"
