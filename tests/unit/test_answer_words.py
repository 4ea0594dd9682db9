"""What the screen says of an answer: the name, how far to trust it, and nothing else unasked."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console

from tagid.cli.imaging import describe
from tagid.operate.turn import Answer, read
from tagid.operate.words import coverage_words, truth_words
from tagid.operate.workplace import Workplace
from tagid.result import Redrawn
from tagid.simulate.acquisition import Acquisition, Placement
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name


def shown(answer: Answer, verbose: bool = False) -> list[str]:
    printed = io.StringIO()
    Console(file=printed, width=400).print(Redrawn(describe(answer, "", verbose), str))
    return [line.rstrip() for line in printed.getvalue().splitlines()]


@pytest.fixture(scope="module")
def answer(tmp_path_factory: pytest.TempPathFactory) -> Answer:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TAGID_DATA", str(tmp_path_factory.mktemp("data")))
        setup = Workplace({}).setup()
    acquisition = Acquisition(views=36, snr_db=20.0, placement=Placement((0.003, -0.002), 0.3))
    capture, _ = simulate_capture(scene_from_name("helmet-120"), acquisition, seed=3)
    return read(setup, capture, "a.tagid.h5")


def test_a_name_takes_three_lines(answer: Answer) -> None:
    name, trust, truth = shown(answer)
    assert name == "HELMET-120   Helmet, 120 degrees"
    assert re.fullmatch(r"  at most 1 in [1-9][\d,]+ such objects is named wrongly \(simulated\)", trust)
    assert truth.startswith("  truth: helmet-120: named rightly, rotation ")
    assert any(line.startswith("  read as: ") for line in shown(answer, verbose=True))


def test_a_part_of_a_turn_and_a_missing_bound_are_always_shown(answer: Answer) -> None:
    result = answer.identification
    part = replace(result, coverage=0.42, reading=replace(result.reading, bound=None))
    assert shown(replace(answer, identification=part))[1] == (
        "  no bound on wrong names: the views cover 151 of 360 degrees"
    )
    early = replace(result, coverage=0.7)
    assert "  caution: the views cover 252 of 360 degrees" in shown(replace(answer, identification=early))
    assert coverage_words(0.99) == coverage_words(None) == ""


def test_the_pose_is_compared_with_the_truth_over_the_symmetry_of_the_layout(answer: Answer) -> None:
    truth = answer.truth
    assert truth is not None and truth.right and truth.layout == "helmet-120"
    assert truth.rotation_error_deg is not None and abs(truth.rotation_error_deg) < 1.0
    assert truth.centre_error_m is not None and truth.centre_error_m < 1e-3
    assert truth_words(replace(truth, right=False, rotation_error_deg=None, centre_error_m=None)) == (
        "helmet-120: not named"
    )
