"""The promise behind a name: counts of objects without an enrolled tag; and what a person sets of it."""

from __future__ import annotations

import json
from dataclasses import fields
from itertools import pairwise
from math import inf, log
from pathlib import Path

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.config import load_config
from tagid.errors import ModelError, UsageError
from tagid.operate.workplace import Workplace
from tagid.pipeline.identify import reader_settings
from tagid.pipeline.settings import ImagingSettings, TagPriors
from tagid.reading.calibration import BARE_WORTH, DIGITS, KEPT, Bound, Calibration, Stratum, largest, worth
from tagid.reading.columns import Priors
from tagid.reading.reader import ReaderSettings, contest
from tagid.tags.layouts.layout import builtin_layouts
from train.calibrate import Row, ranges, strata

KNOWN = Calibration(
    "a test", ((0, 2000),), (Stratum(12, 24, 99, (2.0,)), Stratum(24, 361, 1999, (12.0, 11.0, 10.5)))
)


def test_a_calibration_promises_no_more_than_it_counted() -> None:
    bound = KNOWN.bound(11.5, 36, 1e-3)
    # One object of 1999 is as convincing, and the next one may be.
    assert bound == Bound(2 / 2000, 1e-3, 1999, "24 to 360 views", "a test")
    assert bound.reachable and bound.kept
    assert KNOWN.bound(13.0, 36, 1e-3).p_value == 1 / 2000
    assert KNOWN.bound(10.7, 36, 2e-3).kept and not KNOWN.bound(10.7, 36, 1e-3).kept
    # Below the leads that were kept nothing is promised.
    assert KNOWN.bound(10.4, 36, 1e-3).p_value == 1.0
    assert not KNOWN.bound(99.0, 36, 1e-4).reachable
    assert not KNOWN.bound(99.0, 23, 1e-3).reachable and KNOWN.bound(99.0, 23, 1e-2).kept
    for views in (11, 361):
        assert KNOWN.bound(99.0, views, 1e-3).objects == 0
        assert KNOWN.needed(views, 0.5).lead == KNOWN.needed(views, 0.5).bare == inf


def test_the_lead_that_is_needed_is_that_from_which_the_promise_holds() -> None:
    """Ties, rounding, and leads that were not kept, at every setting that can be made."""
    rng = np.random.default_rng(6)
    every = np.round(rng.exponential(4.0, 400), 1)
    some = Stratum(24, 361, len(every), largest(every.tolist()))
    assert len(some.leads) == KEPT < len(every)
    for false_accept in (1e-3, 2e-3, 4e-3, 5e-3, 0.02, 0.1, 0.149, 0.151, 0.5):
        needed = some.needed(false_accept)
        if needed == inf:
            assert 1 / (len(every) + 1) > false_accept
            continue
        assert some.p_value(needed) <= false_accept
        assert np.count_nonzero(every >= needed) + 1 <= false_accept * (len(every) + 1)
        smallest = some.leads[-1] + 10**-DIGITS
        assert some.p_value(needed - 2 * 10**-DIGITS) > false_accept or needed == pytest.approx(smallest)
    asked = [some.needed(false_accept) for false_accept in (0.003, 0.01, 0.05, 0.2)]
    assert all(first > other for first, other in pairwise(asked[:3])) and asked[3] <= asked[2] < inf


def test_the_p_value_is_never_below_that_of_all_objects() -> None:
    rng = np.random.default_rng(7)
    every = rng.normal(size=100)
    kept = Stratum(24, 361, len(every), largest(every.tolist())[:12])
    for lead in np.linspace(-3, 3, 121):
        exact = (np.count_nonzero(every >= lead) + 1) / (len(every) + 1)
        assert kept.p_value(float(lead)) >= exact
        if lead > kept.leads[0]:
            assert kept.p_value(float(lead)) == exact


def test_a_lead_without_a_body_counts_more_and_neither_less_than_theory_asks() -> None:
    stratum = Stratum(24, 361, 1999, (60.0, 30.0))
    needed = Calibration("a test", (), (stratum,)).needed(36, 1e-3)
    assert needed.lead == pytest.approx(30.01) and needed.bare == pytest.approx(30.01 / BARE_WORTH, abs=1.0)
    assert worth(40.0, 3.0) == 40.0 and worth(-5.0, -1.0) == -5.0
    assert worth(3.0, 3.0) == 3.0 and worth(8.0, 7.0) == 35.0
    # A name that one of the two carries keeps the promise.
    assert stratum.p_value(worth(8.0, needed.bare)) <= 1e-3
    assert stratum.p_value(worth(needed.lead, -9)) <= 1e-3
    easy = Calibration("a test", (), (Stratum(24, 361, 9999, (-3.0,) * 60),))
    for false_accept in (1e-3, 1e-4):
        asked = easy.needed(36, false_accept)
        assert min(asked.lead, asked.bare) >= log(1 / false_accept)


def test_a_calibration_is_kept_as_text_and_damage_is_seen() -> None:
    text = KNOWN.to_json()
    assert Calibration.from_json(text) == KNOWN
    data = json.loads(text)
    wrong = ["", "{}", "[]", text[:-20]]
    wrong += [
        json.dumps(data | {"format_version": 1}),
        json.dumps(data | {"strata": [{"views": [12], "objects": 1, "leads": []}]}),
        json.dumps(data | {"strata": [{"views": [12, 24], "objects": 1, "leads": ["x"]}]}),
        json.dumps(data | {"seeds": [3]}),
    ]
    for damaged in wrong:
        with pytest.raises(ModelError, match="calibration is damaged"):
            Calibration.from_json(damaged)


def test_the_package_has_a_calibration_for_every_number_of_views_from_12_on() -> None:
    shipped = Calibration.shipped()
    assert shipped.population and Calibration.from_json(shipped.to_json()) == shipped
    for views in (12, 17, 18, 23, 24, 72, 360):
        assert shipped.needed(views, 5e-3).lead < inf
    assert shipped.needed(11, 5e-3).lead == inf
    limits = [(item.views_from, item.views_to) for item in shipped.strata]
    assert all(before[1] <= after[0] for before, after in pairwise(sorted(limits)))


def test_leads_of_the_file_are_rounded_up() -> None:
    assert largest([0.1234, 0.5, -0.001, -3.0]) == (0.5, 0.13, 0.0, -3.0)
    assert largest([float(n) for n in range(100)]) == tuple(float(n) for n in range(99, 99 - KEPT, -1))


def rows(*given: tuple[int, int, float]) -> list[Row]:
    return [Row(seed=seed, views=views, lead=lead) for seed, views, lead in given]


def test_objects_are_counted_by_their_views() -> None:
    made = strata(rows((1, 12, 3.0), (2, 17, 5.0), (3, 18, -2.0), (4, 360, 1.0), (5, 11, 9.0)))
    assert [(item.name, item.objects, item.leads) for item in made] == [
        ("12 to 17 views", 2, (5.0, 3.0)),
        ("18 to 23 views", 1, (-2.0,)),
        ("24 to 360 views", 1, (1.0,)),
    ]
    many = strata(rows(*((n, 36, float(n)) for n in range(80))), (24, 361))
    assert [(item.objects, len(item.leads), item.leads[0]) for item in many] == [(80, KEPT, 79.0)]
    assert ranges([5, 6, 8, 1005, 9000, 9001]) == ((5, 1006), (9000, 9002))
    assert ranges([7]) == ((7, 8),)


@pytest.fixture(autouse=True)
def nothing_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))


def test_the_defaults_are_those_of_the_calibration() -> None:
    stored = Workplace(load_config({})).imaging()
    assert stored.priors == TagPriors()
    assert reader_settings(stored) == reader_settings(ImagingSettings()) == ReaderSettings()
    needed = Calibration.shipped().needed(36, stored.false_accept)
    assert np.isfinite(needed.lead), "the calibration bears the default out"


def test_what_is_set_reaches_the_reader() -> None:
    values = {"tags.centre_sigma_m": 0.02, "tags.radius_sigma_m": 0.004, "tags.false_accept": 0.02}
    made = reader_settings(Workplace(load_config(values)).imaging())
    assert made.priors == Priors(0.02, 0.004) and made.false_accept == 0.02
    scans = synthetic_scans(builtin_layouts()["container-90"].positions, views=24)
    assert contest(scans, list(builtin_layouts().values()), (), made.priors).priors == made.priors
    assert not reader_settings(ImagingSettings(direction_known=False)).direction_known
    early = reader_settings(ImagingSettings(false_accept=4e-3), 0.75)
    assert early.false_accept == pytest.approx(1e-3), "the rest that early looks leave"


@pytest.mark.parametrize("name", [field.name for field in fields(TagPriors)])
@pytest.mark.parametrize("value", [-0.01, 0.06, np.nan])
def test_priors_have_bounds(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=name):
        TagPriors(**{name: value})
