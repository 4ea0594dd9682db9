"""What a person sets reaches the reader, within bounds."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.config import load_config
from tagid.errors import UsageError
from tagid.operate.workplace import Workplace
from tagid.pipeline.identify import reader_settings
from tagid.pipeline.settings import ImagingSettings, TagPriors
from tagid.reading.calibration import Calibration
from tagid.reading.columns import Priors
from tagid.reading.reader import ReaderSettings, contest
from tagid.tags.layouts.layout import builtin_layouts


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


def test_early_looks_leave_a_name_the_rest_of_the_setting() -> None:
    settings = ImagingSettings(false_accept=4e-3)
    assert reader_settings(settings, 0.75).false_accept == pytest.approx(1e-3)
    assert reader_settings(settings).false_accept == 4e-3


@pytest.mark.parametrize("name", [field.name for field in fields(TagPriors)])
@pytest.mark.parametrize("value", [-0.01, 0.06, np.nan])
def test_priors_have_bounds(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=name):
        TagPriors(**{name: value})
