"""The field at a thin elliptic shell, against the exact one of a round shell and against its symmetries."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.fields.thin_shell import EllipticShell, ShellField
from tagid.fields.shells import Shell, echoes

K = 2 * np.pi / SPEED_OF_LIGHT * np.array([3.2e9, 4.0e9, 4.8e9])
ANGLES = np.linspace(0, np.pi, 25)


@pytest.mark.parametrize("radius_m", [0.09, 0.11, 0.13])
def test_a_round_shell_is_the_exact_one(radius_m: float) -> None:
    """1.5 mm of plastic on a radius of 80 mm: before it, beside it and behind it."""
    thick, permittivity = 1.5e-3, 2.8
    wall = Shell(0.08 + thick / 2, thick, permittivity, False)
    exact = echoes(K, [wall], radius_m, ANGLES)[0, 0]
    exact = exact / np.exp(2j * K[:, None] * radius_m * np.cos(ANGLES))
    field = ShellField.of(K, EllipticShell(0.08, 0.08, (permittivity - 1) * thick))
    # The exact one is that of a plane wave.
    found = field.seen_from(200 * np.exp(1j * ANGLES)).relative(np.array([radius_m + 0j]))[:, 0]
    assert np.abs(exact - 1).max() > 0.6
    assert np.abs(found - exact).max() < 0.02


def test_the_echo_of_a_round_shell_does_not_depend_on_aspect() -> None:
    field = ShellField.of(K, EllipticShell(0.08, 0.08, 2.7e-3))
    antenna = np.exp(1j * np.linspace(0, 2 * np.pi, 17))
    for echo in np.moveaxis(field.seen_from(antenna).echoes(3), 1, 0):
        assert np.abs(echo - echo[:, :1]).max() < 1e-3 * np.abs(echo).max()


def test_turning_the_shell_is_turning_the_antenna_the_other_way() -> None:
    """A quarter of a turn exchanges the half axes."""
    places = 0.11 * np.exp(1j * np.array([0.3, 1.9]))
    antenna = np.exp(1j * np.linspace(0.1, 6.0, 11))
    one = ShellField.of(K, EllipticShell(0.076, 0.097, 2.7e-3))
    other = ShellField.of(K, EllipticShell(0.097, 0.076, 2.7e-3))
    np.testing.assert_allclose(one.echo(antenna), other.echo(1j * antenna), rtol=1e-9)
    np.testing.assert_allclose(
        one.seen_from(antenna).relative(places),
        other.seen_from(1j * antenna).relative(1j * places),
        rtol=1e-9,
    )


def test_more_points_of_the_contour_change_little() -> None:
    shell = EllipticShell(0.076, 0.097, 2.7e-3)
    antenna, places = np.exp(1j * np.linspace(0.1, 6.0, 11)), 0.105 * np.exp(1j * ANGLES)
    coarse, fine = (ShellField.of(K, shell, n).seen_from(antenna).relative(places) for n in (84, 300))
    assert np.abs(coarse - fine).max() < 0.02


def test_a_thinner_sheet_does_less() -> None:
    """In the limit of no sheet a reflector is alone: to first order what is added is proportional to it."""
    antenna, place = np.exp(1j * np.linspace(0.1, 6.0, 11)), np.array([0.11 + 0j])
    added = [
        ShellField.of(K, EllipticShell(0.076, 0.097, sheet)).seen_from(antenna).relative(place) - 1
        for sheet in (2e-5, 4e-5)
    ]
    assert np.abs(added[1] - 2 * added[0]).max() < 0.02 * np.abs(added[1]).max()


def test_places_outside_and_inside() -> None:
    shell = EllipticShell(0.07, 0.10, 2.7e-3)
    np.testing.assert_allclose(
        shell.outside_m(np.array([0.08, 0.09j, -0.07, 0.12j])), [0.01, -0.01, 0.0, 0.02], atol=1e-12
    )


@pytest.mark.parametrize("sizes", [(0.0, 0.1, 1e-3), (0.1, 2.0, 1e-3), (0.1, 0.1, 0.0), (0.1, 0.1, 0.1)])
def test_shells_that_cannot_be(sizes: tuple[float, float, float]) -> None:
    with pytest.raises(DataError):
        EllipticShell(*sizes)
