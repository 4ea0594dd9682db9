"""The field beside round shells: against other solutions of the same bodies, and conservation of energy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.fields.bessel import bessel
from tagid.fields.shells import Shell, echoes, reflection
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
