"""A reader whose calibration takes any evidence: for tests of the tests that come before it."""

from __future__ import annotations

import numpy as np

from tagid.tags.bodies.calibration import Basis, Calibration, Scores, Stratum
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import ReaderSettings

ALL = dict.fromkeys(Basis, Scores(10**6))
ANY = Calibration("none, for these tests alone", (Stratum(1, 1000, -np.inf, np.inf, ALL),), {})
SETTINGS = ReaderSettings(contest=ContestSettings(calibrated=ANY))
