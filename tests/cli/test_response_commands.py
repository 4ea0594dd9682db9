"""`tagid simulate --response` and `tagid emulate p440 --response`, with the shipped responses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.storage.importers import read_any
from tests.processes import emulated_radar

RESPONSES = Path(__file__).resolve().parents[1] / "data" / "responses"
TAGGED, BODY = RESPONSES / "can30_c180.npz", RESPONSES / "can30.npz"


def test_simulate_from_a_response(tagid, tmp_path: Path) -> None:
    words = ["simulate", "--response", TAGGED, "--snr-reference", TAGGED, "--snr-reference-body", BODY]
    words += ["--centre", "0.008,-0.006", "--rotation", 30, "--views", 24, "--axis-error", 0.01, "--seed", 3]
    ran = tagid(*words, "--out", "made.npz", "--output", "json")
    assert ran.code == 0, ran.err
    assert ran.json["data"]["scene"] == "can30_c180"
    truth = ran.json["data"]["truth"]
    assert truth["noise_std"] == pytest.approx(0.1)
    assert (truth["snr_reflector_db"], truth["snr_summed_db"]) == (None, pytest.approx(20.0))
    assert "per reflector it is not known" in truth["snr_reference"]
    capture = read_any(tmp_path / "made.npz")
    assert capture.views == 24 and capture.axis_distance_m == pytest.approx(1.01)
    assert capture.object.snr_reference == "can30_c180 without can30"
    np.testing.assert_allclose(capture.object.reflectors_m, [[0.045, 0], [-0.045, 0]], atol=1e-9)
    # The body moves with its tag: off the axis it does not vanish with the mean over the views.
    words[words.index("0.008,-0.006")] = "0,0"
    assert tagid(*words, "--out", "centred.npz").code == 0
    turning, centred = (
        np.std(c.samples - c.samples.mean(axis=0)) for c in (capture, read_any(tmp_path / "centred.npz"))
    )
    assert turning > 1.3 * centred


def test_horizontal_polarisation_is_another_response(tagid, tmp_path: Path) -> None:
    captures = []
    for letter in ("V", "h"):
        words = ("--polarisation", letter, "--views", 8, "-o", f"{letter}.npz")
        ran = tagid("simulate", "--response", TAGGED, *words)
        assert ran.code == 0, ran.err
        captures.append(read_any(tmp_path / f"{letter}.npz").samples)
    assert np.abs(captures[0] - captures[1]).max() > 0.2


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["simulate"], 2, "either a scene or --response"),
        (["simulate", "can", "--response", TAGGED], 2, "either a scene or --response"),
        (["simulate", "--response", TAGGED, "--polarisation", "X"], 2, "no polarisation"),
        (["simulate", "--response", TAGGED, "--axis-distance", 0.3], 2, "nearer than"),
        (["simulate", "--response", TAGGED, "--antenna-height", 0.2], 2, "above the plane"),
        (["simulate", "--response", TAGGED, "--range-law"], 2, "cannot be combined"),
        (["simulate", "--response", "none.npz"], 1, "no such file"),
        (["simulate", "--response", __file__], 1, "damaged"),
        (["simulate", "--response", TAGGED, "--snr-reference-body", BODY], 2, "without a ref"),
        (["simulate", "--response", TAGGED, "--body", "can", "--reflector", "octahedron"], 2,
         "error: --body and --reflector cannot be combined with --response"),
        (["simulate", "--response", TAGGED, "--elevation", "50mm"], 2, "0.050 m below"),
        (["emulate", "p440", "--response", TAGGED, "--replay", "x.out"], 2, "--response cannot be"),
        (["emulate", "p440", "--response", TAGGED, "--file", "x.toml", "--reflector", "o", "--budget"], 2,
         "error: --file, --reflector and --budget cannot be combined with --response"),
        (["emulate", "p440", "--response", TAGGED, "--wobble", 0.9], 2, "wobble"),
        (["emulate", "p440", "--replay", "x.out", "--scene", "can"], 2,
         "error: --scene cannot be combined with"),
    ],
)  # fmt: skip
def test_bad_options_get_one_error(words: list[object], code: int, says: str, tagid, tmp_path: Path) -> None:
    ran = tagid(*words, *(("--out", "x.npz") if words[0] == "simulate" else ()))
    assert ran.code == code, ran.err
    assert says in ran.err and ran.err.count("error:") == 1
    assert not (tmp_path / "x.npz").exists()


def test_emulate_from_a_response_on_a_real_socket(tagid, home: dict[str, str], tmp_path: Path) -> None:
    """The emulated radar is recorded over UDP; the echo in the recording is that of the response."""
    words = ["--response", TAGGED, "--rpm", 30, "--snr", 30, "--axis-distance", 2.0, "--centre", "0.01,0"]
    with emulated_radar(home, *words, "--rotation", 20, "--rate", 0) as (url, _):
        ran = tagid("radar", "record", "--radar", url, "--scans", 30, "--out", "seen.tagid.h5")
    assert ran.code == 0, ran.err
    capture = read_any(tmp_path / "seen.tagid.h5")
    moving = capture.samples - capture.samples.mean(axis=0)
    strongest = capture.ranges_m[np.abs(moving).max(axis=0).argmax()]
    assert 1.85 < strongest < 2.1  # the can's wall; the radar's window begins at 1.5 m
