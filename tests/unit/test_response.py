"""Responses: what is interpolated, drawn and stored, against a point whose response is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Pulse
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, StorageError, UsageError
from tagid.simulate import (
    Acquisition,
    Placement,
    Points,
    RangeWindow,
    Scene,
    Snr,
    StaticReturns,
    Wobble,
    simulate_capture,
)
from tagid.simulate.response import Response, Ring
from tagid.simulate.response_file import read_response, write_response
from tagid.simulate.response_scene import ResponseBody, peak_echo, response_scene
from tests.benchmarks.fullwave_scenes import FULLWAVE, OWN, full_wave

PLACE = np.array([0.04, 0.025, 0.0])
RINGS = tuple(Ring(d, p) for d in (0.8, 1.0, 1.2) for p in "VH")


def point_response(
    place: np.ndarray = PLACE,
    frequency_hz: np.ndarray | None = None,
    aspects: int = 72,
    rings: tuple[Ring, ...] = RINGS,
    sigma: float = 0.01,
) -> Response:
    """b = sigma exp(-2jk (d - R)) (R / d)^2 of a point that returns sigma exp(-2jkd) / d^2; H is weaker."""
    f = np.linspace(1.5e9, 6.6e9, 86) if frequency_hz is None else frequency_hz
    k = 2 * np.pi * f / SPEED_OF_LIGHT
    b = np.empty((len(f), len(rings), aspects), dtype=np.complex128)
    angle = 2 * np.pi * np.arange(aspects) / aspects
    for i, ring in enumerate(rings):
        along = ring.distance_m * np.exp(1j * angle)
        antenna = np.stack([along.real, along.imag, np.full(aspects, ring.height_m)], axis=1)
        d = np.linalg.norm(antenna - place, axis=1)
        size = sigma if ring.polarisation == "V" else 0.3 * sigma
        b[:, i] = size * np.exp(-2j * np.outer(k, d - ring.range_m)) * (ring.range_m / d) ** 2
    return Response("point", f, rings, b.astype(np.complex64), place[None, :2], {"made": "by formula"})


def test_between_rings_and_aspects_the_response_is_that_of_the_point() -> None:
    """Any distance and direction, also beyond the rings; a wrong sign or an unnormalised phase is far off."""
    response = point_response()
    rng = np.random.default_rng(0)
    angle, distance = rng.uniform(0, 2 * np.pi, 40), rng.uniform(0.7, 3.0, 40)
    antennas = np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(40)], axis=1)
    d = np.linalg.norm(antennas - PLACE, axis=1)
    exact = 0.01 * np.exp(-2j * np.outer(d - distance, response.wavenumber)) * ((distance / d) ** 2)[:, None]
    seen = response.seen_from(antennas)
    assert np.abs(seen / exact - 1).max() < 0.01
    np.testing.assert_allclose(response.seen_from(antennas, "H"), 0.3 * seen, rtol=1e-4)


def test_with_one_distance_the_near_field_is_that_of_its_ring() -> None:
    response = point_response(rings=(Ring(1.0, "V"),))
    near, at, far = (response.seen_from(np.array([[d, 0.0, 0.0]])) for d in (0.8, 1.0, 2.0))
    np.testing.assert_allclose(near, far)
    np.testing.assert_allclose(at[0], response.scattering_length_m[:, 0, 0], rtol=1e-5)


def test_antenna_heights_are_interpolated_too() -> None:
    rings = tuple(Ring(d, "V", h) for d in (0.8, 1.0, 1.2) for h in (-0.1, 0.0, 0.1))
    place = np.array([0.04, 0.025, 0.03])
    response = point_response(place, np.linspace(2.8e9, 5.2e9, 41), rings=rings)
    antennas = np.array([[0.6, 0.7, 0.04], [-0.9, 0.5, -0.07]])
    d, r = np.linalg.norm(antennas - place, axis=1), np.linalg.norm(antennas, axis=1)
    exact = 0.01 * np.exp(-2j * np.outer(d - r, response.wavenumber)) * ((r / d) ** 2)[:, None]
    assert np.abs(response.seen_from(antennas) / exact - 1).max() < 0.03
    with pytest.raises(UsageError, match=r"0\.200 m above"):
        response.seen_from(np.array([[1.0, 0.0, 0.2]]))


@pytest.mark.parametrize("direction", [1, -1])
def test_a_response_is_recorded_as_the_point_it_stands_for(direction: int) -> None:
    """The same capture as of a point reflector: off the axis, turned, wobbling, with the room and the noise.

    The point is at PLACE in the object; its spreading refers to the antenna's distance from it.
    """
    acq = Acquisition(
        views=24, direction=direction, axis_distance_m=1.1, placement=Placement((0.01, -0.015), 0.7),
        wobble=Wobble(0.01, 0.002), axis_distance_error_m=0.01, snr_db=40, range_law=True,
    )  # fmt: skip
    room = StaticReturns(np.array([0.6, 1.4]), np.array([2.0, -1.0]))
    points = Scene("point", (Points(PLACE[None], np.ones(1)),), room=room, reference_amplitude=1.0)
    expected, truth = simulate_capture(points, acq, seed=5)
    scene = response_scene(point_response(), replace(acq, range_law=False), room=room)
    # The scale makes the strongest echo over a centred turn 1: that of the point at its nearest.
    nearest = (1.1 / (1.1 - np.hypot(*PLACE[:2]))) ** 2
    got, _ = simulate_capture(scene, replace(acq, range_law=False), seed=5)
    rest = truth.clean - truth.clean.mean(axis=0)
    scaled = got.samples - expected.samples + (1 - 1 / nearest) * rest
    assert np.sqrt(np.mean((scaled - scaled.mean(axis=0)) ** 2)) < 0.02 * np.sqrt(np.mean(rest**2))
    assert got.axis_distance_m == pytest.approx(1.11)
    np.testing.assert_array_equal(got.angles_rad, expected.angles_rad)


def test_the_snr_refers_to_the_reference() -> None:
    tag, body = point_response(), point_response(np.zeros(3), sigma=0.1)
    both = Response("both", tag.frequency_hz, RINGS, tag.scattering_length_m + body.scattering_length_m)
    acq = Acquisition(views=36, snr_db=20)
    scene = response_scene(both, acq, reference=both.without(body))
    capture, truth = simulate_capture(scene, acq, seed=1)
    assert truth.noise_std == pytest.approx(0.1)
    assert np.std(capture.samples - truth.clean) == pytest.approx(0.1, rel=0.05)
    # The body is ten times the tag, whose peak is the unit.
    assert peak_echo(scene.object[0], acq) == pytest.approx(10, rel=0.15)
    assert scene.description["snr_reference"] == "both without point"


def test_the_printed_snr_says_what_it_is_against() -> None:
    """Of one reflector as reference both are known; of two together not that of each, of a body neither."""
    first, acq = point_response(), Acquisition(views=36, snr_db=20)
    turned = np.array([-PLACE[1], PLACE[0], 0.0])
    other = point_response(turned)
    both = first.scattering_length_m + other.scattering_length_m
    two = replace(first, name="two", scattering_length_m=both, reflectors_m=np.array([PLACE[:2], turned[:2]]))
    body = replace(point_response(np.zeros(3)), name="body", reflectors_m=np.zeros((0, 2)))

    def snr(shown: Response, reference: Response | None, acquisition: Acquisition = acq) -> Snr:
        return simulate_capture(response_scene(shown, acquisition, reference=reference), acquisition)[1].snr

    result = snr(two, first)
    peaks = [peak_echo(ResponseBody(item), acq) for item in (first, two)]
    assert result.reflector_db == pytest.approx(20)
    assert result.summed_db == pytest.approx(20 + 20 * np.log10(peaks[1] / peaks[0]), abs=0.05)
    assert result.summed_db > 21 and "2 like that of point, taken to have no body" in str(result)
    assert snr(two, first, replace(acq, snr_reference="summed")).summed_db == pytest.approx(20)
    assert "noise 20.0 dB summed, of the 2 of two without body; per" in str(snr(first, two.without(body)))
    assert "peak over noise 20.0 dB, of the whole object, body included" in str(snr(two, None))
    assert str(snr(two, body)).endswith("20.0 dB, of body; how many reflectors it has is not stated")
    assert "own reflectors are not stated" in str(snr(body, first)) and "summed" not in str(snr(body, first))
    far = replace(two, reflectors_m=np.array([[0.9, 0.0], [0.0, 0.05]]))
    assert "of the object's 2 it is not known" in str(snr(far, first))


def gaussian() -> Pulse:
    """The pulse of the shared scenes."""
    t = np.arange(-1500, 1501) * 2e-12
    return Pulse(np.exp(-2 * (np.pi * 0.494e9 * t) ** 2) * np.cos(2 * np.pi * 4.0e9 * t), 2e-12)


@pytest.mark.skipif(not FULLWAVE.is_dir(), reason="the full-wave responses are not in the shared data folder")
@pytest.mark.parametrize(
    ("name", "polarisation"), [("can35_c90", "V"), ("shell_h120_20", "V"), ("free40_lin", "H")]
)
def test_captures_of_the_shared_responses_agree_with_the_shared_scenes(name: str, polarisation: str) -> None:
    """Another program's capture of the same file, object off the axis and turned: same samples but for a
    scale."""
    centre, rotation, distance = (0.006, -0.011), 1.3, 1.07
    scan, _ = full_wave().make(
        name, np.random.default_rng(0), reference=name, views=20, distance=distance, centre=centre,
        rotation=rotation, pol=polarisation, snr_db=300, room=False,
    )  # fmt: skip
    window = RangeWindow(scan["range_start_m"], scan["samples"].shape[1])
    acq = Acquisition(
        views=20,
        axis_distance_m=distance,
        placement=Placement(centre, rotation),
        pulse=gaussian(),
        window=window,
    )
    response = read_response(FULLWAVE / "responses" / f"{name}.npz")
    _, truth = simulate_capture(response_scene(response, acq, polarisation), acq)
    theirs, ours = scan["samples"].astype(np.float64), truth.clean
    scale = (theirs * ours).sum() / (ours * ours).sum()
    assert np.sqrt(np.mean((theirs - scale * ours) ** 2) / np.mean(theirs**2)) < 0.01


def test_a_file_holds_everything(tmp_path: Path) -> None:
    rings = tuple(Ring(d, "V", h) for d in (0.8, 1.2) for h in (0.0, 0.1))
    response = point_response(rings=rings)
    write_response(tmp_path / "r.npz", response)
    back = read_response(tmp_path / "r.npz")
    np.testing.assert_array_equal(back.scattering_length_m, response.scattering_length_m)
    np.testing.assert_array_equal(back.frequency_hz, response.frequency_hz)
    np.testing.assert_array_equal(back.reflectors_m, response.reflectors_m)
    assert (back.name, back.rings, back.provenance) == (response.name, rings, response.provenance)


def test_the_plain_layout_is_normalised_when_read(tmp_path: Path) -> None:
    response = point_response(rings=(Ring(0.8, "V"), Ring(1.0, "H")))
    r = np.array([0.8, 1.0])
    factor = np.exp(-2j * np.outer(response.wavenumber, r)) / r**2
    np.savez(
        tmp_path / "p.npz",
        S=(response.scattering_length_m * factor[..., None]).astype(np.complex64),
        freqs=response.frequency_hz,
        azimuth=2 * np.pi * np.arange(72) / 72,
        ring_distance=r,
        ring_pol=np.array(["V", "H"]),
    )
    back = read_response(tmp_path / "p.npz")
    assert back.rings == response.rings and back.name == "p"
    np.testing.assert_allclose(back.scattering_length_m, response.scattering_length_m, atol=2e-8)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda a: a.pop("aspect_rad"), "lacks aspect_rad"),
        (lambda a: a.pop("format"), "not a response file"),
        (lambda a: a.update(format=np.array("tagid.capture")), "format is 'tagid.capture'"),
        (lambda a: a.update(format_version=np.int64(2)), "newer"),
        (lambda a: a.update(format_version=np.array([1, 2])), "format_version"),
        (lambda a: a.update(aspect_rad=a["aspect_rad"] * 0.5), "aspects are not"),
        (lambda a: a.update(aspect_rad=a["aspect_rad"][:-1]), "71,"),
        (lambda a: a.update(frequency_hz=a["frequency_hz"][::-1].copy()), "evenly spaced"),
        (lambda a: a.update(frequency_hz=a["frequency_hz"] ** 2), "evenly spaced"),
        (lambda a: a.update(ring_polarisation=np.array(["V"] * 6)), "every combination"),
        (lambda a: a.update(ring_polarisation=np.array(["X"] * 6)), "expected V or H"),
        (lambda a: a.update(ring_distance_m=np.zeros(6)), "ring distance is 0"),
        (lambda a: a.update(ring_distance_m=np.ones(5)), "expected the same"),
        (lambda a: a.update(scattering_length_m=a["scattering_length_m"] * np.nan), "not finite"),
        (lambda a: a.update(scattering_length_m=a["scattering_length_m"] * 1e300), "not finite"),
        (lambda a: a.update(scattering_length_m=np.array("x")), "dtype"),
        (lambda a: a.update(reflectors_m=np.zeros(3)), "reflectors"),
        (lambda a: a.update(provenance=np.array("[1]")), "expected an object"),
        (lambda a: a.update(name=np.array([1.0])), "one text"),
    ],
)
def test_a_bad_file_gets_one_clear_error(
    change: Callable[[dict[str, np.ndarray]], object], says: str, tmp_path: Path
) -> None:
    write_response(tmp_path / "r.npz", point_response())
    with np.load(tmp_path / "r.npz") as loaded:
        arrays = dict(loaded)
    with np.errstate(all="ignore"):
        change(arrays)
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(FileFormatError, match=says) as caught:
        read_response(tmp_path / "bad.npz")
    assert "bad.npz" in caught.value.message


def test_damage_objects_and_missing_files_are_errors(tmp_path: Path) -> None:
    write_response(tmp_path / "r.npz", point_response())
    whole = (tmp_path / "r.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "flip.npz").write_bytes(whole[:3000] + bytes([whole[3000] ^ 0x55]) + whole[3001:])
    np.savez(tmp_path / "pickle.npz", format=np.array([{}], dtype=object), allow_pickle=True)
    for name in ("cut", "flip", "pickle"):
        with pytest.raises(FileFormatError):
            read_response(tmp_path / f"{name}.npz")
    with pytest.raises(StorageError):
        read_response(tmp_path / "none.npz")


def test_what_a_response_does_not_cover_is_refused() -> None:
    response = point_response(rings=(Ring(1.0, "V"),))
    with pytest.raises(UsageError, match="no polarisation 'H'"):
        response.seen_from(np.array([[1.0, 0.0, 0.0]]), "H")
    with pytest.raises(UsageError, match="nearer"):
        response.seen_from(np.array([[0.3, 0.0, 0.0]]))
    with pytest.raises(UsageError, match="differ in frequencies"):
        response.without(point_response())
    with pytest.raises(DataError, match="no echo"):
        silent = Response("silent", response.frequency_hz, response.rings, 0 * response.scattering_length_m)
        response_scene(response, Acquisition(), reference=silent)


def test_the_solved_objects_are_what_they_say() -> None:
    """A dozen in two megabytes: readable, over the band, and of a size that such objects have."""
    paths = sorted(OWN.glob("*.npz"))
    assert len(paths) >= 12 and sum(path.stat().st_size for path in paths) < 2_000_000
    for path in paths:
        response = read_response(path)
        assert (response.name, response.polarisations) == (path.stem, ("V", "H"))
        assert response.frequency_hz[0] <= 2.8e9 and response.frequency_hz[-1] >= 5.2e9, path
        rcs_dbsm = 10 * np.log10(np.maximum(4 * np.pi * np.abs(response.scattering_length_m) ** 2, 1e-30))
        assert rcs_dbsm.mean() > -50 and rcs_dbsm.max() < 0, path
