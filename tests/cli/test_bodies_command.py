"""`tagid simulate` with bodies: what it writes and prints, and one clear error per unreadable option."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tagid.simulate.snr import REFERENCES
from tagid.storage.importers import read_any


def test_a_tag_on_a_can_is_written_with_its_truth(tagid, tmp_path: Path) -> None:
    words = (
        "--body",
        "can:35mm,handle",
        "--reflector",
        "octahedron:20mm",
        "--elevation",
        "50mm",
        "--views",
        12,
    )
    more = ("--centre", "0.004,-0.003", "--rotation", 30, "--snr", 10, "--pulse", "random", "--unlike", 2)
    done = tagid("simulate", "container-90", *words, *more, "--noise-colour", 0.5, "--interference", -3,
                 "--out", "can.tagid.h5", "--output", "json")  # fmt: skip
    assert done.code == 0, done.err
    truth = done.json["data"]["truth"]
    assert truth["snr_reflector_db"] == pytest.approx(10) and truth["snr_summed_db"] > 10
    capture = read_any(tmp_path / "can.tagid.h5")
    reported = capture.object
    assert (reported.body, reported.reflector) == ("can:35mm,handle", "octahedron:20mm")
    assert (reported.truth.elevation_m, reported.truth.rotation_deg) == pytest.approx((0.05, 30))
    assert capture.pulse is None and capture.antenna_height_m == 0
    # The echo on the wire is that of the can and its handle: far above the tag's.
    noise = truth["noise_std"]
    assert 20 * np.log10(np.abs(capture.samples - capture.samples.mean(axis=0)).max() / noise) > 15


def test_both_snrs_are_printed_and_the_option_says_which_it_sets(tagid) -> None:
    for reference in ("reflector", "summed"):
        done = tagid("simulate", "helmet-120", "--views", 18, "--snr", 12, "--snr-of", reference,
                     "--out", f"{reference}.tagid.h5")  # fmt: skip
        assert done.code == 0, done.err
        shown = " ".join(done.out.split())
        assert ("12.0 dB per reflector" in shown) == (reference == "reflector")
        assert ("12.0 dB summed" in shown) == (reference == "summed")


def test_the_help_names_the_values_that_are_accepted(tagid) -> None:
    text = " ".join(tagid("simulate", "--help").out.split())
    (line,) = re.findall(r"--snr-of (.*?) --noise-colour ", text)
    assert all(value in line for value in REFERENCES) and "or sum." not in line


def test_the_object_stays_while_the_recording_changes(tagid, tmp_path: Path) -> None:
    words = ("simulate", "container-90", "--body", "can:35mm,handle", "--unlike", 3, "--views", 12)
    recorded = {}
    for seed, of_object in ((1, 5), (2, 5), (5, None)):
        fixed = () if of_object is None else ("--object-seed", of_object)
        for noise in (0, 1):
            done = tagid(*words, "--seed", seed, *fixed, "--noise", noise, "--out", f"{seed}{noise}.npz")
            assert done.code == 0, done.err
            recorded[seed, noise] = read_any(tmp_path / f"{seed}{noise}.npz")
    for seed in (2, 5):
        np.testing.assert_array_equal(recorded[1, 0].samples, recorded[seed, 0].samples)
        assert np.abs(recorded[1, 1].samples - recorded[seed, 1].samples).std() > 0.5
    assert [recorded[seed, 0].object.seed for seed in (1, 2, 5)] == [5, 5, 5]
    assert [recorded[seed, 0].radar.seed for seed in (1, 2, 5)] == [1, 2, 5]


@pytest.mark.parametrize(
    ("option", "value", "named"),
    [
        ("--body", "can:35", "--body can"),
        ("--body", "teapot", "teapot"),
        ("--body", "can:200mm", "200mm"),
        ("--body", "can:60mm", "45 mm from the axis"),
        ("--reflector", "octahedron:200mm", "200mm"),
        ("--elevation", "2m", "--elevation"),
        ("--snr-of", "all", "all"),
        ("--pulse", "square", "square"),
        ("--noise-colour", "2", "2"),
        ("--interference", "90", "90"),
        ("--unlike", "3", "--unlike"),
    ],
)
def test_one_clear_error_each(tagid, tmp_path: Path, option: str, value: str, named: str) -> None:
    done = tagid(
        "simulate", "container-90", option, value, "--views", 12, "--out", "x.h5", "--output", "json"
    )
    assert done.code == 2, done
    (error,) = done.json["errors"]
    assert (error["code"], named in error["message"]) == ("usage", True), error
    assert error["remedy"]
    assert not (tmp_path / "x.h5").exists()
