"""The title of a picture names what it shows."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.geometry import ImageGrid
from tagid.imaging.types import Image
from tagid.operate.words import method_shown
from tagid.pipeline.reconstruct import Reconstruction


@pytest.mark.parametrize(
    ("settings", "title"),
    [
        ({}, "ATS"),
        ({"prior": "dense, aspect"}, "ATS"),
        ({"prior": "linear 4"}, "ATS, linear solution"),
        ({"prior": "linear 1"}, "ATS, backprojection"),
        ({"prior": "pixels"}, "ATS, sparse solution"),
        ({"preset": "paper"}, "ATS, paper"),
    ],
)
def test_an_image_without_a_field_is_not_shown_as_a_fit(settings: dict[str, str], title: str) -> None:
    image = Image(np.ones((2, 2), np.complex64), ImageGrid(0.5, 2), dict(settings))
    assert method_shown(Reconstruction(image, "ats", None, 36, {})) == title
