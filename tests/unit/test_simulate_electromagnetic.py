"""Cylinder and plate against what is known of them by other ways: moments, optics, the far field."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import hankel2

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import Acquisition, Recording, Scene, simulate_capture
from tests.benchmarks.electromagnetic import (
    BAND_HZ,
    ConductingCylinder,
    Plate,
    cylinder_series,
    metal_box,
)


def field(body: object, antenna: tuple[float, float], frequency_hz: np.ndarray) -> np.ndarray:
    """sum_i a_i exp(-2jk d_i): what the points of a body send back at each frequency."""
    position = np.array([[*antenna, 0.0]])
    returns = body.returns(position)
    distance = np.linalg.norm(returns.points - position[:, None], axis=2)[0]
    k = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT
    return np.exp(-2j * np.outer(k, distance)) @ returns.amplitudes[0]


def by_moments(ka: float, cells: int = 400) -> complex:
    """S of the cylinder from its surface current (electric field integral equation, point matching).

    Independent of the series: sum_m (k h / 4) H0(k |r_n - r_m|) J_m = E_n, with the logarithmic self term.
    """
    phi = 2 * np.pi * np.arange(cells) / cells
    arc = 2 * np.pi * ka / cells
    xy = ka * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    np.fill_diagonal(distance, 1.0)
    kernel = hankel2(0, distance) * arc
    np.fill_diagonal(kernel, arc * (1 - 2j / np.pi * (np.log(np.exp(0.5772156649) * arc / 4) - 1)))
    current = np.linalg.solve(kernel, np.exp(-1j * xy[:, 0]))
    # E_s = -sum J H0(k |r - r_m|) arc -> far field sqrt(2j / pi k rho) exp(-jk rho) times this, at phi = pi.
    return complex(-(current * np.exp(1j * xy @ np.array([-1.0, 0.0]))).sum() * arc)


@pytest.mark.parametrize("ka", [0.5, 2.5, 5.0])
def test_series_agrees_with_the_method_of_moments(ka: float) -> None:
    assert abs(by_moments(ka) / cylinder_series(np.array([ka]))[0] - 1) < 0.02


def test_series_reaches_geometrical_optics() -> None:
    ka = np.array([60.0])
    # Physical optics of the lit side: -sqrt(pi ka) / 2 exp(2j ka - j pi / 4), echo width pi a.
    optics = -np.sqrt(np.pi * ka) / 2 * np.exp(2j * ka - 1j * np.pi / 4)
    assert abs(cylinder_series(ka) / optics - 1)[0] < 0.02


def test_points_carry_the_series_over_the_band() -> None:
    can = ConductingCylinder(0.033, 0.12, (0.1, -0.05))
    frequency = np.linspace(*BAND_HZ, 101)
    distance = np.hypot(1.0 - 0.1, 0.05)
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    expected = can.scattering_length(frequency) * np.exp(-2j * k * distance)
    got = field(can, (1.0, 0.0), frequency)
    assert np.abs(got - expected).max() < 0.02 * np.abs(expected).max()


def test_a_distant_plate_has_its_far_field() -> None:
    plate = Plate(0.2, 0.1)
    frequency = np.array([3e9, 4e9, 5e9])
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    ahead = field(plate, (400.0, 0.0), frequency)
    assert np.abs(np.abs(ahead) / (0.2 * 0.1 * frequency / SPEED_OF_LIGHT) - 1).max() < 0.01
    turned = np.deg2rad(11.0)
    aside = field(plate, (400 * np.cos(turned), 400 * np.sin(turned)), frequency)
    pattern = np.abs(np.sinc(k * 0.2 * np.sin(turned) / np.pi)) * np.cos(turned)
    assert np.abs(np.abs(aside) / np.abs(ahead) - pattern).max() < 0.01
    assert np.abs(field(plate, (-400.0, 0.0), frequency)).max() == 0


def test_a_large_plate_is_a_mirror_at_half_the_power_of_its_image() -> None:
    # Many Fresnel zones: field of the image source at distance 2R, b / R^2 = -1 / (2 R).
    distance = 0.5
    plate = Plate(3.0, 3.0)
    frequency = np.linspace(3e9, 5e9, 41)
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    position = np.array([[distance, 0.0, 0.0]])
    returns = plate.returns(position)
    r = np.linalg.norm(returns.points - position[:, None], axis=2)[0]
    seen = (np.exp(-2j * np.outer(k, r)) / r**2) @ returns.amplitudes[0]
    expected = -np.exp(-2j * k * distance) / (2 * distance)
    assert np.abs((seen / expected).mean() - 1) < 0.05


def test_a_box_flashes_where_its_sides_are() -> None:
    acquisition = Acquisition(views=90, recording=Recording("complex64"))
    grid = ImageGrid(0.5, 100)
    settings = PreprocessSettings("none", True, extent_m=grid.extent)
    box, _ = simulate_capture(Scene("box", metal_box(0.2413, 0.2)), acquisition)
    image = np.abs(backproject(preprocess(box, settings=settings), grid).values)
    # Seen head-on, each side flashes where its middle lies (moved a little: a plane is no point to the turn).
    profile = image[48:52, 50:].mean(axis=0)
    assert abs(grid.axis[50:][int(np.argmax(profile))] - 0.2413 / 2) < 0.012


def test_a_can_returns_from_its_lit_side() -> None:
    acquisition = Acquisition(views=4, recording=Recording("complex64"))
    can, _ = simulate_capture(Scene("can", (ConductingCylinder(0.033),)), acquisition)
    envelope = np.abs(can.samples)
    power = envelope**4
    at = (power * can.ranges_m).sum(axis=1) / power.sum(axis=1)
    assert np.abs(at - (1 - 0.033)).max() < 0.006


def test_symmetry_an_object_turned_is_the_aperture_turned_back() -> None:
    turn = 0.3
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    frequency = np.array([3.5e9, 4.4e9])
    here = Aperture.turntable(angles, 1.0).positions
    back = Aperture.turntable(angles + turn, 1.0).positions
    # The radar sees the object turned by `turn` as it sees the unturned one at angles + turn.
    for a, b in zip(here, back, strict=True):
        turned = sum(field(p, tuple(a[:2]), frequency) for p in metal_box(0.2, 0.1, rotation_rad=turn))
        unturned = sum(field(p, tuple(b[:2]), frequency) for p in metal_box(0.2, 0.1))
        np.testing.assert_allclose(turned, unturned, rtol=1e-6, atol=1e-9)


def test_absurd_bodies_are_refused() -> None:
    for make in (lambda: Plate(0.0, 1.0), lambda: ConductingCylinder(-1.0), lambda: Plate(float("nan"), 1.0)):
        with pytest.raises(DataError):
            make()
