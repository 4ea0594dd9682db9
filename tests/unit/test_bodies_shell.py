"""Tags on helmet shells that nobody enrolled.

The responses of tests/data/shells were solved by the method of moments: half ellipsoids of plastic, of which
the reader's elliptic cylinder knows nothing.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from solved_shells import recorded_at

from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField, ShellView, ThinShell
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.hypothesis import Kind, Pose
from tagid.tags.bodies.posing import PoseSearch
from tagid.tags.bodies.shell_decide import ShellDecision, decide_on_shell
from tagid.tags.bodies.shell_model import ShellBody, ShellFit, refined_beside, signature_of
from tagid.tags.bodies.shell_reader import ShellReading, read_on_shell
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.matcher import read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code
from train.population import draw

LAYOUTS = list(builtin_layouts().values())
CENTRE_M = (0.004, -0.0045)


@cache
def recorded(name: str, views: int = 36, snr_db: float = 20.0, polarisation: str = "V") -> BasebandScans:
    """A recording 6 mm off the axis."""
    return recorded_at(CENTRE_M, "shells", name, views, snr_db, polarisation)


def read(name: str, **more: float | str) -> Reading:
    return read_tag(recorded(name, **more), LAYOUTS)  # type: ignore[arg-type]


@cache
def shell_reading(name: str) -> ShellReading:
    found = read_on_shell(Spectra.of(recorded(name)), LAYOUTS, BodySettings())
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("name", "layout"), [("shell74_h120", "helmet-120"), ("shell74_lin", "helmet-linear")]
)
@pytest.mark.parametrize("polarisation", ["V", "H"])
def test_a_tag_on_a_shell_is_named_without_enrolment(name: str, layout: str, polarisation: str) -> None:
    reading = read(name, polarisation=polarisation)
    assert (reading.status, reading.layout, reading.kind) == ("identified", layout, Kind.SHELL)
    assert np.hypot(*np.subtract(reading.centre_m, CENTRE_M)) < 1.5e-3
    assert reading.bound is None
    assert reading.hypotheses[0].kind is Kind.SHELL and reading.hypotheses[0].left < 0.1
    shell = reading.body
    assert shell is not None and isinstance(shell.body, ShellBody)
    # Half a wall's curvature less than the ellipsoid's half axes of 74 and 96 mm.
    assert shell.body.fit.shell.across_m == pytest.approx(0.0715, abs=4e-3)
    assert shell.body.fit.shell.along_m == pytest.approx(0.0930, abs=4e-3)


def test_half_the_views_are_enough_and_a_third_are_not() -> None:
    assert read("shell74_lin", views=18).layout == "helmet-linear"
    assert read_on_shell(Spectra.of(recorded("shell74_lin", views=12)), LAYOUTS, BodySettings()) is None


@pytest.mark.parametrize("name", ["shell74", "shell79_three"])
@pytest.mark.parametrize("views", [18, 36])
def test_an_untagged_shell_and_a_foreign_tag_are_not_named(name: str, views: int) -> None:
    assert read(name, views=views).status != "identified"


@pytest.mark.parametrize(("wrong", "times"), [("none", 2), ("conjugate", 3.5), ("inverse", 6)])
def test_the_shell_fixes_what_its_reflectors_return(
    wrong: str, times: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflectors that it does not change, or changes with a wrong sign, leave far more of the echo."""
    right, relative = shell_reading("shell74_h120").reading, ShellView.relative
    made = {"none": np.ones_like, "conjugate": np.conj, "inverse": lambda x: 1 / x}[wrong]
    monkeypatch.setattr(ShellView, "relative", lambda *a: made(relative(*a)))
    found = read_on_shell(Spectra.of(recorded("shell74_h120")), LAYOUTS, BodySettings())
    assert found is None or found.reading.unexplained > times * right.unexplained
    assert found is None or found.reading.lead < 0.7 * right.lead


def test_layouts_on_small_and_on_large_rings_are_not_read_on_shells() -> None:
    spectra = Spectra.of(recorded("shell74_h120"))
    containers = [one for one in LAYOUTS if one.kind == "container"]
    large = Layout("large", np.array([[0.4, 0.0], [-0.4, 0.0], [0.0, 0.4]]))
    assert read_on_shell(spectra, containers, BodySettings()) is None
    assert read_on_shell(spectra, [large], BodySettings()) is None


def test_a_helmet_is_found_beside_layouts_on_larger_rings() -> None:
    """Shells are sought inside every ring, not inside the largest alone."""
    large = Layout("large", 0.15 * np.array([[1.0, 0.0], [-0.5, 0.866], [-0.3, -0.95]]))
    spectra = Spectra.of(recorded("shell74_h120"))
    found = read_on_shell(spectra, [large, *LAYOUTS], BodySettings())
    assert found is not None and found.reading.layouts[0].layout == "helmet-120"
    assert decide_on_shell(found, ShellDecision()).status == "identified"


@pytest.mark.parametrize("level", [0.0, 1e-12])
def test_scans_without_an_echo_are_read_without_an_error(level: float) -> None:
    spectra = Spectra.of(recorded("shell74_h120"))
    quiet = replace(spectra, data=level * spectra.data)
    found = read_on_shell(quiet, LAYOUTS, BodySettings())
    assert found is None or decide_on_shell(found, ShellDecision()).status != "identified"


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"body_energy": 0.0}, Code.BODY),
        ({"tag_nats": 50.0}, Code.WEAK),
        ({"unexplained": 0.3}, Code.BODY),
        ({"pose": Pose((0.02, 0.0))}, Code.OFF_CENTRE),
        ({"angle_off_deg": 20.0}, Code.OTHER),
        ({"radius_off_m": 0.02}, Code.RADIUS),
        ({"lead": 0.2}, Code.OTHER),
    ],
)
def test_every_test_of_a_name_on_a_shell(changes: dict[str, object], code: Code) -> None:
    found = shell_reading("shell74_h120")
    assert decide_on_shell(found, ShellDecision()).status == "identified"
    changed = replace(found, reading=replace(found.reading, **changes))  # type: ignore[arg-type]
    verdict = decide_on_shell(changed, ShellDecision())
    assert (verdict.status, verdict.code) == ("unknown", code)


def test_the_middle_of_a_tag_on_a_shell() -> None:
    three, linear = shell_reading("shell74_h120"), shell_reading("shell74_lin")
    assert (three.has_middle, linear.has_middle) == (False, True)
    assert linear.middle_lead > 0.3
    missing = decide_on_shell(replace(linear, middle_lead=-0.1), ShellDecision())
    unseen = decide_on_shell(replace(linear, middle_nats=0.1, middle_lead=0.1), ShellDecision())
    assert (unseen.code, "move it" in unseen.reason) == (Code.MISSING, True)
    extra = decide_on_shell(replace(three, middle_nats=0.6, middle_lead=-0.5), ShellDecision())
    assert (missing.code, extra.code) == (Code.MISSING, Code.EXTRA)
    # A variance of noise for one in the middle is no reflector.
    noise = decide_on_shell(replace(three, middle_nats=0.3, middle_lead=-0.12), ShellDecision())
    assert noise.status == "identified"
    # 6 mm off the axis a reflector in the middle must show; on it, none can.
    hidden = replace(three, middle_nats=0.05, middle_lead=-0.05)
    assert decide_on_shell(hidden, ShellDecision()).code is Code.EXTRA
    assert decide_on_shell(hidden, ShellDecision(off_axis_m=0.01)).status == "identified"


def test_the_shape_is_found_from_a_start_beside_it() -> None:
    """Waves of the model itself, with a reflector of known echo: shape and pose come out exactly."""
    spectra = Spectra.of(recorded("shell74"))
    shell, pose = EllipticShell(0.076, 0.097, 2.8e-3), Pose((0.003, -0.002), 0.7)
    antenna = (spectra.antenna - pose.centre) * np.exp(-1j * pose.turn_rad)
    away = np.abs(spectra.antenna - 0.11)
    tag = centred(spectra.waves(away) * (spectra.distance_m / away) ** 2)
    echo = ShellField.of(spectra.wavenumbers / 2, shell).echo(antenna)
    echo = echo / np.abs(echo).max() * 5 * np.exp(1j * spectra.wavenumbers[:, None])
    made = replace(spectra, data=centred(echo) + tag, noise=1e-6)
    start = ShellFit(EllipticShell(0.0775, 0.0955, 2.8e-3), Pose((0.004, -0.001), 0.73), 0.0)
    found = refined_beside(made, start, tag, 1, 8)
    assert found.left < 1e-3 * made.energy
    np.testing.assert_allclose(
        [found.shell.across_m, found.shell.along_m, *found.pose.centre_m, 0.1 * found.pose.turn_rad],
        [shell.across_m, shell.along_m, *pose.centre_m, 0.1 * pose.turn_rad],
        atol=4e-4,
    )


@pytest.mark.parametrize(
    ("shell", "alike"), [(EllipticShell(0.075, 0.095, 2.8e-3), 2), (BoxShell(0.06, 0.06, 2.8e-3), 4)]
)
def test_a_shell_is_sought_over_its_own_turns_only(shell: ThinShell, alike: int) -> None:
    """Half a turn of an ellipse, and a quarter of one of a square, are its whole search."""
    spectra = Spectra.of(recorded("shell74"))
    signature = signature_of(shell, spectra.wavenumbers, 0.9)
    search = PoseSearch(spectra, signature.order)
    (left, pose), (least, whole) = search.best(signature, alike), search.best(signature)
    assert left == pytest.approx(least, rel=1e-6)
    assert pose.centre_m == whole.centre_m
    assert pose.turn_rad == pytest.approx(whole.turn_rad % (2 * np.pi / alike), abs=1e-9)


def test_harmonics_of_a_shell_are_its_echo() -> None:
    """About a centre off the axis and turned, at another distance than that of the table."""
    spectra = replace(Spectra.of(recorded("shell74")), height_m=np.zeros(36))
    shell, pose = EllipticShell(0.072, 0.094, 2.8e-3), Pose((0.003, 0.002), 0.4)
    body = ShellBody(ShellFit(shell, pose, 0.0), spectra.wavenumbers, 0.9)
    antenna = (spectra.antenna - pose.centre) * np.exp(-1j * pose.turn_rad)
    exact = centred(ShellField.of(spectra.wavenumbers / 2, shell).echo(antenna))
    found = centred(body.echo(spectra, np.array([pose.centre]), np.array([pose.turn_rad]))[0])
    along = np.abs((found.conj() * exact).sum(axis=1)) ** 2
    size = (np.abs(found) ** 2).sum(axis=1) * (np.abs(exact) ** 2).sum(axis=1)
    assert (along / size).min() > 0.995
    assert signature_of(shell, spectra.wavenumbers, 0.9).turning_share > 0.3


def test_a_layout_on_a_shell_leaves_less_than_without_one() -> None:
    """Two bare reflectors of `helmet-120`: as points they leave half of what the three on a shell leave."""
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(draw(9030460).capture, settings=settings), LAYOUTS)
    assert (reading.status, reading.code) == ("unknown", Code.MISSING)
