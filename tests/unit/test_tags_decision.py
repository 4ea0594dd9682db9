"""The decision: one case for each branch and threshold, and the likelihoods that it weighs."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.errors import UsageError
from tagid.tags.reading.decision import (
    DecisionSettings,
    Evidence,
    chance,
    decide,
    least_preference,
    nats_needed,
    odds,
    preference,
)
from tagid.tags.verdicts.verdict import Code, Verdict


def test_chance_is_the_tail_of_the_energy_of_noise() -> None:
    rng = np.random.default_rng(1)
    energy = rng.exponential(size=(200_000, 3)).sum(axis=1)
    assert chance(6.0, 3, 1.0) == pytest.approx(float(np.mean(energy > 6.0)), rel=0.03)
    assert chance(3.0, 3, 1e6) == 1.0
    # Of two scans: Gamma(2 K), searched at P^2 pairs of places.
    energy = rng.exponential(size=(400_000, 4)).sum(axis=1)
    assert chance(9.0, 2, 1.5, 2) == pytest.approx(1.5**2 * float(np.mean(energy > 9.0)), rel=0.03)
    assert chance(0.0, 3, 1.0) == chance(-5.0, 3, 1.0) == 1.0
    assert chance(60.0, 3, 2000.0, 2) < chance(30.0, 3, 2000.0)


def evidence(**changed: float) -> Evidence:
    """A clear tag of three reflectors, 30 nats each."""
    usual = {
        "size": 3,
        "nats": 90.0,
        "places": 36600.0,
        "share": 1.0,
        "weakest": 0.9,
        "missing": 0,
        "extra": 0,
        "gain_nats": 7.0,
        "further_nats": 7.0,
        "odds_nats": 16.0,
        "outward": 0.0,
        "noise_nats": 90.0,
        "displacement_m": 1e-3,
        "displacement_sigma_m": 1e-3,
        "margin_share": 0.5,
        "margin_nats": 40.0,
        "views": 36,
    }
    return Evidence(**(usual | changed))  # type: ignore[arg-type]


def test_a_smaller_false_accept_asks_for_a_clearer_preference() -> None:
    tag = evidence()
    assert least_preference(tag, 1e-4) > least_preference(tag, 1e-3) > least_preference(tag, 1e-2)
    with pytest.raises(UsageError, match="false-accept"):
        DecisionSettings(false_accept=0.0)


def test_unenrolled_tags_show_a_further_reflector_or_fit_better_elsewhere() -> None:
    tag = evidence()
    settings = DecisionSettings()
    assert decide(tag, settings).status == "identified"
    # A further reflector as strong as the tag's own would explain about 30 nats; 18 are half way there.
    assert preference(tag) > preference(evidence(gain_nats=12.0)) > preference(evidence(gain_nats=18.0))
    assert preference(evidence(gain_nats=1.0)) >= preference(evidence(gain_nats=5.0)) - 3
    assert decide(evidence(gain_nats=16.0, odds_nats=6.0), settings).status == "unknown"
    # Among faint reflectors, and in few views, a further one may be lost: what is enough else is not there.
    assert preference(evidence(nats=36.0, noise_nats=36.0)) < preference(tag) - 3
    assert least_preference(evidence(views=18), 1e-3) > least_preference(tag, 1e-3) + 3
    assert least_preference(evidence(views=360), 1e-3) == least_preference(tag, 1e-3)
    # However surely no further reflector is there, points elsewhere may fit better than the layout's.
    assert (
        decide(evidence(odds_nats=-16.0, noise_nats=600.0, nats=600.0, gain_nats=25.0), settings).status
        == "unknown"
    )
    # More enrolled layouts can be matched by chance.
    assert least_preference(evidence(places=366000.0), 1e-3) > least_preference(tag, 1e-3) + 2


def answer(**changed: float) -> tuple[str, str]:
    verdict = decide(evidence(**changed), DecisionSettings())
    return verdict.status, verdict.reason


def test_every_reason_of_the_decision_has_its_threshold() -> None:
    """One step on either side of each threshold, all else as a clear tag has it."""
    s = DecisionSettings()
    assert answer() == ("identified", "")
    places = evidence().places
    faint = next(n for n in np.arange(5.0, 40.0, 0.01) if chance(n, 3, places) <= s.false_accept)
    assert answer(nats=faint - 0.02)[0] == "no_tag"
    assert answer(nats=faint)[0] != "no_tag"
    assert answer(share=0.4499) == ("unknown", "the nearest layout explains 45% of the echo")
    assert answer(share=0.45)[0] == "identified"
    assert answer(missing=1) == ("unknown", "the nearest layout lacks 1 reflector")
    limit = s.gain_nats + s.gain_spread_nats + s.gain_share * 90.0  # 8 + 5 + 5.4 nats
    assert limit == pytest.approx(18.4)
    assert answer(further_nats=limit - 0.01)[0] == "identified"
    assert answer(further_nats=limit + 0.01) == (
        "unknown",
        "points elsewhere explain 20% more than the nearest layout",
    )
    assert answer(further_nats=limit + 0.01, extra=2) == (
        "unknown",
        "2 strong reflectors beyond the nearest layout",
    )
    assert answer(extra=2)[0] == "identified"
    assert answer(displacement_m=6.99e-3)[0] == "identified"  # 3 mm and four deviations of 1 mm
    assert answer(displacement_m=7.01e-3) == ("unknown", "reflectors lie 7.0 mm from the nearest layout's")
    assert answer(outward=-0.5)[0] == "identified"
    assert "through the object" in answer(outward=-0.51)[1]
    assert "too weak" in answer(odds_nats=0.01)[1]
    assert "points elsewhere explain the echo better" in answer(odds_nats=-0.01)[1]
    asked = least_preference(evidence(), s.false_accept)
    off = asked - preference(evidence())
    assert answer(odds_nats=16.0 + off + 0.01)[0] == "identified"
    assert "too weak" in answer(odds_nats=16.0 + off - 0.01)[1]
    assert answer(margin_share=0.0599)[0] == "ambiguous"
    assert answer(margin_share=0.06)[0] == "identified"
    assert answer(margin_nats=4.99)[0] == "ambiguous"
    assert answer(margin_nats=5.0)[0] == "identified"


def test_thresholds_of_several_scans_are_those_of_their_sums() -> None:
    """Of n scans the energy is a sum: means grow with n, spreads with its root."""
    s = DecisionSettings()
    joint = {"scans": 4, "nats": 360.0, "noise_nats": 360.0, "gain_nats": 28.0, "odds_nats": 64.0}
    limit = 4 * s.gain_nats + 2 * s.gain_spread_nats + s.gain_share * 360.0
    assert answer(further_nats=limit - 0.1, **joint)[0] == "identified"
    assert "elsewhere" in answer(further_nats=limit + 0.1, **joint)[1]


def test_the_preference_is_the_likelihood_ratio_that_its_text_writes_down() -> None:
    """Gumbel density of the tag's own additional point over the normal density of an unenrolled tag's."""
    each, gain = 30.0, 7.0
    wide, usual = 1.2 + 0.01 * 90, 6.5 + 0.01 * 90
    x = (gain - usual) / wide
    own = np.exp(-x - np.exp(-x)) / wide
    spread = np.sqrt(2 * each)
    other = np.exp(-0.5 * ((gain - each - 3.0) / spread) ** 2) / (spread * np.sqrt(2 * np.pi))
    assert preference(evidence(gain_nats=gain)) == pytest.approx(16.0 + np.log(own / other))
    # From 100 nats a scan on, 2 % of the energy are the model's own error and taken from every tag.
    error = preference(evidence(noise_nats=600.0)) - preference(evidence(noise_nats=600.0, odds_nats=0.0))
    assert error == pytest.approx(16.0)
    assert "points elsewhere" not in answer(odds_nats=-9.9, noise_nats=600.0, nats=600.0)[1]
    assert (
        "points elsewhere explain the echo better" in answer(odds_nats=-10.1, noise_nats=600.0, nats=600.0)[1]
    )


def test_what_is_asked_grows_as_written() -> None:
    assert least_preference(evidence(), 1e-3) == pytest.approx(8.3)
    assert least_preference(evidence(), 1e-3 / np.e) == pytest.approx(8.3 + 1.6)
    assert least_preference(evidence(places=36600.0 * np.e), 1e-3) == pytest.approx(9.3)
    assert least_preference(evidence(views=24), 1e-3) == pytest.approx(8.3 + 4.0 * 0.5)
    assert least_preference(evidence(views=9), 1e-3) == pytest.approx(8.3 + 4.0)


def test_the_likelihoods_are_flat_where_they_know_nothing() -> None:
    """A further point weaker than any noise makes counts as one at -2 widths; one stronger than a whole
    reflector is no less likely to be one."""
    weak, weaker = evidence(gain_nats=-10.0), evidence(gain_nats=-20.0)
    at_the_clip = evidence(gain_nats=7.4 - 2 * 2.1)
    spread = np.sqrt(2 * 30.0)
    short = [0.5 * ((e.gain_nats - 33.0) / spread) ** 2 for e in (weak, weaker)]
    assert preference(weaker) - preference(weak) == pytest.approx(short[1] - short[0])
    at = 0.5 * ((at_the_clip.gain_nats - 33.0) / spread) ** 2
    assert preference(weak) - preference(at_the_clip) == pytest.approx(short[0] - at)
    assert preference(evidence(gain_nats=7.4 - 1.9 * 2.1)) != pytest.approx(preference(at_the_clip), abs=0.1)
    strong, stronger = evidence(gain_nats=33.0), evidence(gain_nats=53.0)
    wide = 1.2 + 0.01 * 90
    assert preference(stronger) - preference(strong) == pytest.approx(-20.0 / wide, abs=1e-4)


def test_preferences_of_several_scans_add_up() -> None:
    """Four scans alike at the mode of their own gain: a stranger's would be twice as many spreads away."""
    one = evidence(gain_nats=6.5 + 0.9)
    four = evidence(scans=4, nats=360.0, noise_nats=360.0, gain_nats=4 * 7.4, odds_nats=64.0)
    own = -1.0  # at the mode: -x - exp(-x) with x = 0
    ratio = np.log(np.sqrt(2 * 30.0) * np.sqrt(2 * np.pi) / (1.2 + 0.9))
    short = (7.4 - 33.0) / np.sqrt(2 * 30.0)
    assert preference(one) == pytest.approx(16.0 + own + ratio + 0.5 * short**2)
    assert preference(four) == pytest.approx(64.0 + own + ratio + 0.5 * (2 * short) ** 2)
    # Energies need not be whole numbers.
    off = evidence(noise_nats=97.0, gain_nats=33.0 + 4.0)
    each, wide = 97.0 / 3, 1.2 + 0.97
    x = (37.0 - 6.5 - 0.97) / wide
    other = -np.log(np.sqrt(2 * each) * np.sqrt(2 * np.pi))
    assert preference(off) == pytest.approx(16.0 - x - np.exp(-x) - np.log(wide) - other)
    # The model's own error is taken from 100 nats of each scan on.
    known = evidence(scans=4, nats=390.0, noise_nats=400.0, gain_nats=30.0, odds_nats=0.0)
    assert odds(known) == 0.0
    assert odds(evidence(scans=4, noise_nats=450.0, odds_nats=3.0)) == pytest.approx(4.0)


def test_the_first_reason_that_holds_is_given() -> None:
    """Each reason alone, then with all that are looked at after it."""
    reasons = [
        ({"nats": 0.0}, Code.NO_ECHO),
        ({"share": 0.1}, Code.UNEXPLAINED),
        ({"missing": 2}, Code.MISSING),
        ({"further_nats": 60.0, "extra": 1}, Code.EXTRA),
        ({"displacement_m": 0.02}, Code.DISPLACED),
        ({"outward": -0.9}, Code.HIDDEN),
        ({"odds_nats": -1.0}, Code.ELSEWHERE),
        ({"odds_nats": 1.0}, Code.WEAK),
        ({"margin_nats": 0.0}, Code.AMBIGUOUS),
    ]
    for i, (_, code) in enumerate(reasons):
        together: dict[str, float] = {}
        for changed, _ in reversed(reasons[i:]):
            together |= changed
        verdict = decide(evidence(**together), DecisionSettings())
        assert verdict.code == code
        assert verdict.advice and verdict.reason
        alone = decide(evidence(**reasons[i][0]), DecisionSettings())
        assert alone.code == code
    assert decide(evidence(), DecisionSettings()) == Verdict("identified")


@pytest.mark.parametrize(("value", "fine"), [(1e-9, True), (0.5, True), (9e-10, False), (0.51, False)])
def test_the_false_accept_probability_has_bounds(value: float, fine: bool) -> None:
    if fine:
        assert DecisionSettings(false_accept=value).false_accept == value
        return
    with pytest.raises(UsageError, match="false-accept") as caught:
        DecisionSettings(false_accept=value)
    assert str(value) in caught.value.message and "1e-9 to 0.5" in caught.value.remedy


def test_the_nats_that_noise_reaches_by_chance() -> None:
    for size, places, wanted in ((3, 36600.0, 1e-3), (5, 1e6, 1e-2)):
        needed = nats_needed(size, places, wanted)
        assert chance(needed, size, places) == pytest.approx(wanted, rel=1e-6)
        assert chance(needed - 1e-6, size, places) > wanted


def test_how_weak_a_reflector_may_be_depends_on_how_well_it_was_measured() -> None:
    settings = DecisionSettings()
    assert settings.missing_below(1e18) == pytest.approx(0.65)
    assert settings.missing_below(50.0) == pytest.approx(0.65 - 1.5 / 10)
    assert settings.missing_below(1.0) == 0.4
