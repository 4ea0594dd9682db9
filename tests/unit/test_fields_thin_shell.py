"""The field at thin shells, against exact ones of a round shell and an endless sheet, and symmetries."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.fields.shells import Shell, echoes
from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField

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
    result = field.seen_from(200 * np.exp(1j * ANGLES)).relative(np.array([radius_m + 0j]))[:, 0]
    assert np.abs(exact - 1).max() > 0.6
    assert np.abs(result - exact).max() < 0.02


def test_the_echo_of_a_round_shell_does_not_depend_on_aspect() -> None:
    field = ShellField.of(K, EllipticShell(0.08, 0.08, 2.7e-3))
    antenna = np.exp(1j * np.linspace(0, 2 * np.pi, 17))
    for echo in np.moveaxis(field.seen_from(antenna).echoes(3), 1, 0):
        assert np.abs(echo - echo[:, :1]).max() < 1e-3 * np.abs(echo).max()


def test_turning_the_shell_is_turning_the_antenna_the_other_way() -> None:
    """A quarter of a turn exchanges the half axes."""
    positions = 0.11 * np.exp(1j * np.array([0.3, 1.9]))
    antenna = np.exp(1j * np.linspace(0.1, 6.0, 11))
    field = ShellField.of(K, EllipticShell(0.076, 0.097, 2.7e-3))
    other = ShellField.of(K, EllipticShell(0.097, 0.076, 2.7e-3))
    np.testing.assert_allclose(field.echo(antenna), other.echo(1j * antenna), rtol=1e-9)
    np.testing.assert_allclose(
        field.seen_from(antenna).relative(positions),
        other.seen_from(1j * antenna).relative(1j * positions),
        rtol=1e-9,
    )


@pytest.mark.parametrize(
    ("shell", "radius_m", "most"),
    [(EllipticShell(0.076, 0.097, 2.7e-3), 0.105, 0.02), (BoxShell(0.055, 0.07, 2.8e-3), 0.045, 0.03)],
)
def test_more_points_of_the_contour_change_little(
    shell: EllipticShell | BoxShell, radius_m: float, most: float
) -> None:
    antenna, positions = np.exp(1j * np.linspace(0.1, 6.0, 11)), radius_m * np.exp(1j * ANGLES)
    coarse, fine = (ShellField.of(K, shell, n).seen_from(antenna).relative(positions) for n in (84, 300))
    assert np.abs(coarse - fine).max() < most


def test_places_outside_and_inside() -> None:
    shell = EllipticShell(0.07, 0.10, 2.7e-3)
    np.testing.assert_allclose(
        shell.outside_m(np.array([0.08, 0.09j, -0.07, 0.12j])), [0.01, -0.01, 0.0, 0.02], atol=1e-12
    )


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
    np.testing.assert_allclose(
        shell.outside_m(np.array([0.06, 0.04, 0.06j, -0.06 - 0.09j])), [0.01, -0.01, -0.01, 0.02]
    )


def test_a_wall_passes_what_an_endless_sheet_passes() -> None:
    """Behind the middle of a wide wall the field is 1 / (1 + jk (eps - 1) d / 2) of the incident one.

    Source: Balanis, Advanced Engineering Electromagnetics, 1989, section 5.5, for a layer far below the
    wavelength.
    """
    sheet_m, k = 2.8e-3, K[:1]
    shell = BoxShell(0.35, 0.35, sheet_m)
    field = ShellField.of(k, shell, 400)
    behind = np.array([0.35 - d + 0j for d in np.linspace(0.02, 0.20, 60)])
    result = field.seen_from(np.array([200 + 0j])).relative(behind)[0, :, 0]
    # The far walls' echoes change their phase along the line and average out.
    assert abs(np.sqrt(result).mean() - 1 / (1 + 0.5j * k[0] * sheet_m)) < 0.03
