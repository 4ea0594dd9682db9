"""`tagid reconstruct` with what ats learns beside the scene, as an engineer asks for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tagid.simulate import SceneSpec, simulate_capture
from tagid.storage.hdf5 import write_capture


@pytest.fixture(scope="module")
def wobbly(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A turn with 2 % wobble and an assumed axis distance 2 cm too long."""
    scene, acquisition = SceneSpec("points-3", wobble=0.02).build(views=36, axis_distance_error_m=0.02)
    path = tmp_path_factory.mktemp("wobbly") / "w.tagid.h5"
    write_capture(path, simulate_capture(scene, acquisition, 0)[0])
    return path


def test_calibration_is_reported_with_standard_errors(tagid, wobbly) -> None:
    words = ("--background", "none", "--pixels", 64, "--calibrate", "axis,wobble,gain,static")
    done = tagid("reconstruct", wobbly, *words, "--output", "json")
    assert done.code == 0, done.err
    settings = done.json["data"]["settings"]
    result = settings["calibration"]
    assert set(result) == {"axis", "wobble", "gain", "static"}
    assert result["axis"]["distance_m"] == pytest.approx(1.0, abs=4 * result["axis"]["sigma_m"])
    assert result["axis"]["sigma_m"] < 0.003
    assert settings["axis_distance_m"] == result["axis"]["distance_m"]
    assert [w["harmonic"] for w in result["wobble"]] == [1, 2, 3, 4]
    assert all(0 < w["sigma_deg"] < 0.6 for w in result["wobble"])
    assert len(result["gain"]["scans"]) == len(result["gain"]["sigma"])
    text = tagid("reconstruct", wobbly, *words, "--ats", "steps=30")
    assert all(words in text.out for words in ("axis distance 1.00", "wobble, harmonic 1", "±"))


def test_settings_come_from_the_command_line_and_the_configuration(tagid, wobbly) -> None:
    assert tagid("config", "set", "imaging.ats", "robust=3,calibrate=gain").code == 0
    done = tagid("reconstruct", wobbly, "--pixels", 48, "--ats", "robust=2.5,steps=20", "--output", "json")
    settings = done.json["data"]["settings"]
    assert (settings["robust"], settings["steps"], settings["calibrate"]) == (2.5, 20, ["gain"])
    assert list(settings["calibration"]) == ["gain"]


@pytest.mark.parametrize(
    ("words", "stated"),
    [
        (("--ats", "robut=3"), "robust"),
        (("--ats", "steps=many"), "whole number"),
        (("--calibrate", "height"), "axis, wobble, gain, static"),
        (("--method", "bp", "--ats", "steps=9"), "--method ats"),
        (("--method", "bp", "--preset", "paper"), "no effect with bp: --preset"),
        (("--preset", "paper", "--calibrate", "axis"), "--preset field"),
        (("--engine", "jax"), "onnx"),
    ],
)
def test_what_cannot_be_set_is_said(tagid, wobbly, words, stated) -> None:
    done = tagid("reconstruct", wobbly, *words)
    assert done.code == 2 and stated in done.err


def test_the_pulse_is_estimated_where_asked_and_told(tagid, wobbly, tmp_path) -> None:
    done = tagid("reconstruct", wobbly, "--method", "bp", "--pulse", "estimate", "--output", "json")
    assert done.code == 0, done.err
    reported = done.json["data"]["settings"]["pulse"]
    assert reported["kind"] in ("assumed", "estimated") and 0 < reported["residual"] < 1
    assert "pulse" in done.json["data"]["seconds"]
    text = tagid("reconstruct", wobbly, "--method", "bp", "--pulse", "estimate")
    assert "of held-out views unexplained" in text.out
    plain = tagid("reconstruct", wobbly, "--method", "bp", "--output", "json")
    assert plain.json["data"]["settings"]["pulse"] == {"kind": "nominal"}
    assert tagid("reconstruct", wobbly, "--pulse", "guess").code == 2


def test_an_axis_distance_told_wrong_by_3_cm_is_found(tagid) -> None:
    tagid("simulate", "points-3", "--views", 36, "--axis-error", -0.03, "--out", "far.tagid.h5")
    done = tagid("reconstruct", "far.tagid.h5", "--method", "bp", "--background", "none", "--output", "json")
    assert done.json["data"]["settings"]["axis_distance_m"] == pytest.approx(1.0, abs=0.003)


def test_without_held_out_views_no_residual_is_told(tagid, wobbly) -> None:
    words = ("--pixels", 48, "--ats", "steps=20", "--no-held-out")
    done = tagid("reconstruct", wobbly, *words)
    assert done.code == 0 and "held-out residual" not in done.out, done.err
    settings = tagid("reconstruct", wobbly, *words, "--output", "json").json["data"]["settings"]
    assert "held_out" not in settings and settings["held_out_share"] == pytest.approx(0.04)


def test_the_published_method_ends_with_an_image(tagid, wobbly) -> None:
    pytest.importorskip("torch", reason="the published model needs the extra 'ats'")
    words = ("--preset", "paper", "--pixels", 16, "--extent", 0.3, "--png", "paper.png")
    done = tagid("reconstruct", wobbly, *words)
    assert done.code == 0 and "paper.png" in done.out, done.err
