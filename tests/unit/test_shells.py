"""The field at round and thin shells: against other solutions of the same bodies and an endless sheet, by
symmetry and by conservation of energy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.fields.bessel import bessel
from tagid.fields.shells import Shell, echoes, reflection
from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField
from tagid.simulate.multipole import Layer, Multipoles

K = np.linspace(60.0, 105.0, 7)
ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)
CERAMIC, COATED = Shell(0.036, 0.003, 5.0, False), Shell(0.030, 0.004, 6.0, True)


def across(shell: Shell) -> Shell:
    return Shell(shell.radius_m, shell.wall_m, shell.permittivity, shell.metal, "H")


@pytest.mark.parametrize(
    ("shell", "layers"),
    [
        (CERAMIC, (Layer(0.033), Layer(0.036, 5.0))),
        (COATED, (Layer(0.026, complex(np.inf)), Layer(0.030, 6.0))),
        (Shell(0.031, 0.0, 1.0, True), (Layer(0.031, complex(np.inf)),)),
    ],
)
def test_upright_polarisation_is_that_of_the_solution_layer_by_layer(
    shell: Shell, layers: tuple[Layer, ...]
) -> None:
    expected = Multipoles.of(K, layers).field(0.045, ANGLES) ** 2
    assert np.abs(echoes(K, [shell], 0.045, ANGLES)[0, 0] - expected).max() < 1e-5


def test_horizontal_polarisation_of_metal_is_the_exact_series() -> None:
    metal = Shell(0.030, 0.0, 1.0, True, "H")
    result = reflection(K, [metal], 24)[0]
    n = np.arange(25)
    weights = np.where(n == 0, 1, 2) * (-1.0) ** n
    of = bessel(24, K * 0.030)
    # The magnetic field along the axis: the slope of the field is 0 on the metal (Bowman 1969, section 2.2).
    assert np.abs((result + of.dj / of.dh2) @ weights).max() < 1e-9


@pytest.mark.parametrize("shell", [CERAMIC, across(CERAMIC), COATED, across(COATED)])
def test_lossless_bodies_return_all_energy(shell: Shell) -> None:
    """Every order's outgoing wave is as strong as its incoming one: |1 + 2 R_n| = 1."""
    assert np.abs(np.abs(1 + 2 * reflection(K, [shell], 12)) - 1).max() < 1e-9


@pytest.mark.parametrize("polarisation", ["V", "H"])
def test_a_wall_of_air_changes_nothing(polarisation: str) -> None:
    air = Shell(0.030, 0.003, 1.0, False, polarisation)
    direct = np.exp(2j * K[:, None] * 0.045 * np.cos(ANGLES))
    assert np.abs(echoes(K, [air], 0.045, ANGLES)[:, 0] - direct).max() < 1e-5


def test_a_reflector_far_behind_metal_is_in_its_shadow_and_far_before_it_seen_twice() -> None:
    """Before a wide mirror the field is a standing wave: from 0 to 2 times that of the incident one."""
    metal = Shell(0.30, 0.0, 1.0, True)
    electric, magnetic = np.abs(echoes(np.array([83.0]), [metal], 0.319, np.array([0.0, np.pi]))[:, 0, 0])
    # At a quarter of a wavelength before the wall the direct and the reflected wave add up, both ways;
    # the magnetic field has its node there.
    assert 3.5 < electric[0] < 4.5 and electric[1] < 0.05
    assert magnetic[0] < 0.1 and magnetic[1] < 0.05


@pytest.mark.parametrize("polarisation", ["V", "H"])
def test_at_metal_the_field_along_it_vanishes_and_the_magnetic_one_is_doubled(polarisation: str) -> None:
    metal = Shell(0.30, 0.0, 1.0, True, polarisation)
    electric, magnetic = echoes(K, [metal], 0.3001, np.zeros(1))[:, 0, :, 0]
    assert np.abs(electric).max() < 1e-3 and np.abs(np.abs(magnetic) - 4).max() < 0.1


@pytest.mark.parametrize("shell", [CERAMIC, across(CERAMIC), COATED])
def test_the_other_field_is_the_curl_of_the_axial_one(shell: Shell) -> None:
    """By differences of the axial one, G: (grad G)^2 = (grad G^2)^2 / 4 G^2, and H = curl E j / k."""
    radius, step = 0.045, 1e-6
    angles = np.concatenate([ANGLES - step / radius, ANGLES, ANGLES + step / radius])

    def fields(radius_m: float) -> NDArray[np.complex128]:
        both = echoes(K, [shell], radius_m, angles)[:, 0]
        return both if shell.polarisation == "V" else both[::-1]

    (before, axial, behind), (_, other, _) = (x.reshape(len(K), 3, -1).swapaxes(0, 1) for x in fields(radius))
    outside, inside = (fields(radius + d)[0].reshape(len(K), 3, -1)[:, 1] for d in (step, -step))
    squared = (outside - inside) ** 2 + (behind - before) ** 2
    expected = -squared / (2 * step) ** 2 / (4 * K[:, None] ** 2 * axial)
    assert np.abs(other - expected).max() < 1e-3 * np.abs(other).max()


def test_a_reflector_inside_the_body_is_refused() -> None:
    with pytest.raises(DataError, match="inside a shell"):
        echoes(K, [CERAMIC], 0.035, ANGLES)
    with pytest.raises(DataError, match="polarisation"):
        Shell(0.03, 0.003, 5.0, False, "X")
    with pytest.raises(DataError, match="wall"):
        Shell(0.03, 0.03, 5.0, False)


BAND_K = 2 * np.pi / SPEED_OF_LIGHT * np.array([3.2e9, 4.0e9, 4.8e9])
HALF_ROUND = np.linspace(0, np.pi, 25)


@pytest.mark.parametrize("radius_m", [0.09, 0.13])
def test_a_thin_round_shell_is_the_exact_one(radius_m: float) -> None:
    """1.5 mm of plastic on a radius of 80 mm: before it, beside it and behind it."""
    thick, permittivity = 1.5e-3, 2.8
    wall = Shell(0.08 + thick / 2, thick, permittivity, False)
    exact = echoes(BAND_K, [wall], radius_m, HALF_ROUND)[0, 0]
    exact = exact / np.exp(2j * BAND_K[:, None] * radius_m * np.cos(HALF_ROUND))
    field = ShellField.of(BAND_K, EllipticShell(0.08, 0.08, (permittivity - 1) * thick))
    # The exact one is that of a plane wave.
    result = field.seen_from(200 * np.exp(1j * HALF_ROUND)).relative(np.array([radius_m + 0j]))[:, 0]
    assert np.abs(exact - 1).max() > 0.6
    assert np.abs(result - exact).max() < 0.02


def test_the_echo_of_a_round_shell_does_not_depend_on_aspect() -> None:
    field = ShellField.of(BAND_K, EllipticShell(0.08, 0.08, 2.7e-3))
    antenna = np.exp(1j * np.linspace(0, 2 * np.pi, 17))
    for echo in np.moveaxis(field.seen_from(antenna).echoes(3), 1, 0):
        assert np.abs(echo - echo[:, :1]).max() < 1e-3 * np.abs(echo).max()


def test_turning_the_shell_is_turning_the_antenna_the_other_way() -> None:
    """A quarter of a turn exchanges the half axes."""
    positions, antenna = 0.11 * np.exp(1j * np.array([0.3, 1.9])), np.exp(1j * np.linspace(0.1, 6.0, 11))
    shells = EllipticShell(0.076, 0.097, 2.7e-3), EllipticShell(0.097, 0.076, 2.7e-3)
    field, other = (ShellField.of(BAND_K, shell) for shell in shells)
    np.testing.assert_allclose(field.echo(antenna), other.echo(1j * antenna), rtol=1e-9)
    there = other.seen_from(1j * antenna).relative(1j * positions)
    np.testing.assert_allclose(field.seen_from(antenna).relative(positions), there, rtol=1e-9)


@pytest.mark.parametrize(
    ("shell", "radius_m", "most"),
    [(EllipticShell(0.076, 0.097, 2.7e-3), 0.105, 0.02), (BoxShell(0.055, 0.07, 2.8e-3), 0.045, 0.03)],
)
def test_more_points_of_the_contour_change_little(
    shell: EllipticShell | BoxShell, radius_m: float, most: float
) -> None:
    antenna, positions = np.exp(1j * np.linspace(0.1, 6.0, 11)), radius_m * np.exp(1j * HALF_ROUND)
    coarse, fine = (ShellField.of(BAND_K, shell, n).seen_from(antenna).relative(positions) for n in (84, 300))
    assert np.abs(coarse - fine).max() < most


def test_places_outside_and_inside() -> None:
    shell = EllipticShell(0.07, 0.10, 2.7e-3)
    away = shell.outside_m(np.array([0.08, 0.09j, -0.07, 0.12j]))
    np.testing.assert_allclose(away, [0.01, -0.01, 0.0, 0.02], atol=1e-12)


@pytest.mark.parametrize("sizes", [(0.0, 0.1, 1e-3), (0.1, 2.0, 1e-3), (0.1, 0.1, 0.0), (0.1, 0.1, 20.0)])
def test_shells_that_cannot_be(sizes: tuple[float, float, float]) -> None:
    with pytest.raises(DataError):
        EllipticShell(*sizes)


def test_a_box_is_four_walls() -> None:
    shell = BoxShell(0.05, 0.07, 2.8e-3)
    outline = shell.outline(84)
    assert outline.step_m.sum() == pytest.approx(4 * (0.05 + 0.07))
    # Outward of every wall, and a closed contour: normals weighted with length cancel.
    assert abs((outline.normal * outline.step_m).sum()) < 1e-12
    assert ((outline.contour * outline.normal.conj()).real > 0.049).all()
    np.testing.assert_allclose(shell.outside_m(outline.contour), 0, atol=1e-12)
    away = shell.outside_m(np.array([0.06, 0.04, 0.06j, -0.06 - 0.09j]))
    np.testing.assert_allclose(away, [0.01, -0.01, -0.01, 0.02])


def test_a_wall_passes_what_an_endless_sheet_passes() -> None:
    """Behind the middle of a wide wall the field is 1 / (1 + jk (eps - 1) d / 2) of the incident one.

    Source: Balanis, Advanced Engineering Electromagnetics, 1989, section 5.5, for a layer far below the
    wavelength.
    """
    sheet_m, k = 2.8e-3, BAND_K[:1]
    field = ShellField.of(k, BoxShell(0.35, 0.35, sheet_m), 400)
    behind = 0.35 - np.linspace(0.02, 0.20, 60) + 0j
    result = field.seen_from(np.array([200 + 0j])).relative(behind)[0, :, 0]
    # The far walls' echoes change their phase along the line and average out.
    assert abs(np.sqrt(result).mean() - 1 / (1 + 0.5j * k[0] * sheet_m)) < 0.03
