"""Where an enrolled body stands below a tag: solved and simulated waves, at poses off every grid."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies_synthetic import Thing, ring
from bodies_synthetic import capture as drawn
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.simulate import Acquisition, Placement, ReflectorSpec, parse_body, simulate_capture
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.presets import room_clutter
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.bodies.below import read_below
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.enrolled import EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Kind, Pose
from tagid.tags.bodies.joint import Joint, Named, enrol_signature
from tagid.tags.bodies.layout_search import ANGLES, LayoutSearch, turned_by
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.reflectors_fit import FACING, solve
from tagid.tags.bodies.ring import ring_columns
from tagid.tags.bodies.spectra import centred
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching import contest
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
LAYOUTS = builtin_layouts()
ENROLMENT = (Pose((0.002, 0.0), 0.0), Pose((-0.002, 0.0035), 2.1), Pose((-0.003, -0.005), 4.0))
SIMULATED = {
    "shell": ("helmet:101mm", "helmet-120", 0.03),
    "cup": ("cup:33mm,wall=4mm,handle", "container-90", 0.02),
    "large": ("helmet:98mm", "helmet-linear", 0.04),
    "oval": ("cup:36mm,wall=3.4mm,oval=0.2mm", "container-90", 0.02),
    "mug": ("cup:36mm,wall=4.5mm,handle", "container-180", 0.02),
    "loud": ("helmet:101mm", "helmet-linear", 0.04),
}
"""Body, the layout that it carries, and the size of its reflectors, m."""
UNSEEN = (Pose((0.0, 0.0), 0.31), Pose((0.0041, -0.0047), 2.777), Pose((-0.0066, 0.0073), 5.043))
"""Between the steps of the coarse searches: 1.4 and 5 degrees, and 3 mm."""


def recorded(
    what: str,
    pose: Pose,
    seed: int,
    views: int,
    snr_db: float = 20.0,
    places: NDArray[np.float64] | None = None,
) -> Capture:
    """A turn of a solved can with a handle, a simulated shell or a cup, with or without its tag.

    Reflectors stand at `places` (N, 2), m, where given, instead of at the layout's.
    """
    rng = np.random.default_rng([seed, len(what)])
    acquisition = Acquisition(views=views, snr_db=snr_db, placement=Placement(pose.centre_m, pose.turn_rad))
    room = room_clutter(rng)
    if what.startswith("handle"):
        response = read_response(RESPONSES / f"{what}.npz")
        reference = read_response(RESPONSES / "free30_one.npz")
        scene = response_scene(response, acquisition, "V", reference, room)
    else:
        text, layout, tip_m = SIMULATED[what.removesuffix("-tagged")]
        positions = LAYOUTS[layout].positions if what.endswith("-tagged") else np.zeros((0, 2))
        positions = positions if places is None else places
        size, body = ReflectorSpec("octahedron", tip_m), parse_body(text)
        scene = object_scene(what, positions, body, size, rng=rng, room=room, variation=Variation(2.6))
    return simulate_capture(scene, acquisition, seed)[0]


@cache
def enrolled(body: str) -> Joint:
    captures = [Named(f"{i}", aspect_spectra(recorded(body, p, i, 72))) for i, p in enumerate(ENROLMENT)]
    return enrol_signature(captures, body, "body")


def test_an_oval_is_enrolled_in_poses_in_which_its_round_part_agrees() -> None:
    """What turns of it looks alike a quarter turn on, with the gain reversed: a capture was refused."""
    joint = enrolled("oval")
    assert all(residual.is_noise for residual in joint.residuals)
    turns = [one.pose.turn_rad - joint.placed[0].pose.turn_rad for one in joint.placed]
    true = [pose.turn_rad - ENROLMENT[0].turn_rad for pose in ENROLMENT]
    # An oval looks the same after half a turn.
    off = np.angle(np.exp(2j * (np.array(turns) - true))) / 2
    assert np.abs(np.rad2deg(off)).max() < 12


def expected(joint: Joint, pose: Pose) -> Pose:
    """Where the signature stands: its frame is that of the first capture, its centre a point of the body."""
    base, first = joint.placed[0].pose, ENROLMENT[0]
    turn = pose.turn_rad - first.turn_rad
    centre = pose.centre + (base.centre - first.centre) * np.exp(1j * turn)
    return Pose((centre.real, centre.imag), turn + base.turn_rad)


@pytest.mark.parametrize(
    ("body", "tagged", "layout", "pose"),
    [
        ("handle34", "handle34_c90", "container-90", UNSEEN[0]),
        ("handle34", "handle34_c90", "container-90", UNSEEN[2]),
        ("shell", "shell-tagged", "helmet-120", UNSEEN[1]),
        ("cup", "cup-tagged", "container-90", UNSEEN[0]),
        ("cup", "cup-tagged", "container-90", UNSEEN[2]),
    ],
)
def test_a_tag_is_read_at_any_turn_and_centre_of_its_body(
    body: str, tagged: str, layout: str, pose: Pose
) -> None:
    joint = enrolled(body)
    answer = identify(recorded(tagged, pose, 9, 36), list(LAYOUTS.values()), None, None, [joint.signature])
    reading = answer.reading
    assert reading is not None
    assert (answer.status, reading.layout, reading.kind) == ("identified", layout, Kind.BODY), reading.reason
    found = next(one for one in reading.hypotheses if one.kind is Kind.BODY).pose
    # The simulated shell is the same after half a turn, and its tag is louder than what turns of it.
    shell = body == "shell"
    same = [Pose(pose.centre_m, pose.turn_rad + half) for half in ((0.0, np.pi) if shell else (0.0,))]
    right = min((expected(joint, one) for one in same), key=lambda one: abs(_turned(found, one)))
    assert abs(_turned(found, right)) < np.deg2rad(2.0)
    assert abs(found.centre - right.centre) < (1e-3 if body.startswith("handle") else 3e-3)


def test_loud_reflectors_before_a_shell_are_named_with_and_without_its_enrolment() -> None:
    """They were named without a body, and the check of that name ended the reading."""
    capture, layouts = recorded("large-tagged", UNSEEN[1], 0, 36, 10.0), list(LAYOUTS.values())
    blind = identify(capture, layouts).reading
    assert blind is not None
    assert blind.layout in (None, "helmet-linear")
    reading = identify(capture, layouts, None, None, [enrolled("large").signature]).reading
    assert reading is not None
    assert (reading.status, reading.layout) == ("identified", "helmet-linear")


@pytest.mark.parametrize("pose", UNSEEN[1:])
def test_a_tag_on_an_enrolled_mug_is_read_beside_its_wall(pose: Pose) -> None:
    """With free patterns another arrangement explains each of these as well."""
    signatures, layouts = [enrolled("mug").signature], list(LAYOUTS.values())
    reading = identify(recorded("mug-tagged", pose, 9, 36, 10.0), layouts, None, None, signatures).reading
    assert reading is not None and reading.body is not None
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-180", Kind.BODY)
    assert reading.body.body.name == "mug" and reading.body.wall is not None
    # The body keeps the pose in which its handle was found, the tag has a centre of its own.
    assert abs(_turned(reading.body.pose, expected(enrolled("mug"), pose))) < np.deg2rad(2.0)
    others = 0.045 * np.array([[1.0, 0.0], [-0.5, 0.75**0.5]])
    foreign = identify(
        recorded("mug-tagged", pose, 9, 36, 10.0, others), layouts, None, None, signatures
    ).reading
    assert foreign is not None and foreign.layout is None


def test_no_round_wall_is_sought_on_an_enrolled_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs beside small walls inside it were named on untagged shells."""
    assert enrolled("shell").signature.turning_share > ContestSettings().turning
    assert enrolled("mug").signature.turning_share < ContestSettings().turning
    beside, asked = contest.read_beside_wall, list[str]()

    def counted(reading: BodyReading, *rest: Any) -> BodyReading | None:
        asked.append(reading.body.name)
        return beside(reading, *rest)

    monkeypatch.setattr(contest, "read_beside_wall", counted)
    for body in ("shell", "mug"):
        capture, signatures = recorded(body, UNSEEN[1], 9, 36, 10.0), [enrolled(body).signature]
        reading = identify(capture, list(LAYOUTS.values()), None, None, signatures).reading
        assert reading is not None and reading.layout is None
    capture = recorded("mug-tagged", UNSEEN[1], 9, 36, 10.0)
    identify(capture, list(LAYOUTS.values()), None, None, [enrolled("mug").signature])
    assert "mug" in asked and "shell" not in asked


def test_the_middle_of_a_tag_on_an_enrolled_shell_is_as_its_layout_has_it() -> None:
    """A ring of reflectors does not hold it; where the ring is off the rotation axis, it shows."""
    layouts, pose = list(LAYOUTS.values()), UNSEEN[2]
    ring = LAYOUTS["helmet-120"].positions

    def read(body: str, places: NDArray[np.float64] | None = None) -> Reading:
        capture = recorded(f"{body}-tagged", pose, 4, 36, 20.0, places)
        reading = identify(capture, layouts, None, None, [enrolled(body).signature]).reading
        assert reading is not None
        return reading

    assert read("shell").layout == "helmet-120"
    extra = read("shell", np.vstack([ring, np.zeros((1, 2))]))
    assert (extra.layout, extra.code) == (None, Code.EXTRA)
    assert "in the middle of helmet-120" in extra.reason
    assert read("loud").layout == "helmet-linear"
    missing = read("loud", np.array([[0.09, 0.0], [-0.09, 0.0]]))
    assert (missing.layout, missing.code) == (None, Code.MISSING)


def _turned(one: Pose, other: Pose) -> float:
    return float(np.angle(np.exp(1j * (one.turn_rad - other.turn_rad))))


HANDLE = Thing((0.055 + 0.0j, 0.058 + 0.01j), (0.8, -0.6 + 0.5j), wall=8.0)
LOUD = ring(40, 220, amplitude=3.0)
"""Four times the handle's echo: alone, the handle seems to stand where it imitates a reflector."""


@pytest.mark.parametrize("turn", [0.5, 2.9, 4.6])
def test_the_turn_of_a_body_is_found_below_a_louder_tag(turn: float) -> None:
    places = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
    captures = [
        Named(f"{i}", aspect_spectra(drawn(HANDLE, i, centre=c, rotation=t)))
        for i, (c, t) in enumerate(places)
    ]
    joint = enrol_signature(captures, "mug", "body")
    spectra = aspect_spectra(drawn(HANDLE.plus(LOUD), 50, centre=0.004 - 0.004j, rotation=turn, views=36))
    layouts = list(LAYOUTS.values())
    body = EnrolledBody(joint.signature, Searches(joint.signature.order))
    alone = read_on_body(spectra, layouts, body, BodySettings())
    below = read_below(spectra, layouts, body, BodySettings(), [0.004 - 0.004j])
    assert alone is not None and below is not None
    right = turn - places[0][1] + joint.placed[0].pose.turn_rad
    assert abs(np.rad2deg(np.angle(np.exp(1j * (below.pose.turn_rad - right))))) < 3.0
    assert below.layouts[0].layout == "container-180"
    assert below.unexplained < 0.1 and below.layouts[0].left <= 1.02 * alone.layouts[0].left
    # No better pose, no reading.
    assert read_below(spectra, layouts, body, BodySettings(), [0.004 - 0.004j], below.noise * 0.1) is None


def test_the_search_below_a_tag_equals_least_squares() -> None:
    """One turn of tag and body, written out: the columns of both in one system."""
    spectra = aspect_spectra(drawn(HANDLE.plus(LOUD), 50, centre=0.002j, views=36)).thinned(3)
    joint = enrolled("handle34")
    body = EnrolledBody(joint.signature, Searches(joint.signature.order))
    turns = np.array([0.2, 3.0])
    layout, index = LAYOUTS["container-90"], 17
    echoes = body.echo(spectra, np.full(2, 0.002j), turns)
    value = LayoutSearch(spectra, echoes, 0.002j).explained(layout, 0.003, FACING)
    assert value.shape == (ANGLES, 2)
    angles = np.array(turned_by(layout, index))
    columns = ring_columns(spectra, 0.002j, 0.048, FACING, angles).reshape(len(spectra.data), 2, 3, -1)
    for i in range(2):
        both = np.concatenate([centred(echoes[i])[:, None], columns.sum(axis=1)], axis=1)
        left = solve(spectra.data, both[None]).left[0]
        assert spectra.energy - value[index, i] == pytest.approx(left, rel=0.01)
