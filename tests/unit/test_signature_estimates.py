"""Signatures: estimated jointly, matched and refused; on waves drawn with exact distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies_synthetic import MUG, PLACES, TAG, Thing, capture, enrolled

from tagid.errors import DataError
from tagid.pipeline.identify import aspect_spectra
from tagid.simulate import Acquisition, Placement, ReflectorSpec, parse_body, simulate_capture
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.presets import room_clutter
from tagid.tags.bodies import joint, posing, signature
from tagid.tags.bodies.joint import (
    Joint,
    Named,
    Residual,
    _Estimate,
    _residual_energy,
    enroll_signature,
    estimate,
)
from tagid.tags.bodies.likeness import compare, least_tag
from tagid.tags.bodies.posing import PoseSearch, match, refine, round_centre
from tagid.tags.bodies.signature import Pose, Signature, angular, order_of
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.steadying import steadied


def named(thing: Thing, seed: int, centre: complex, rotation: float, **more: float) -> Named:
    taken = capture(thing, seed, centre=centre, rotation=rotation, **more)  # type: ignore[arg-type]
    return Named(f"c{seed}", aspect_spectra(taken))


def three(thing: Thing, **more: float) -> list[Named]:
    return [named(thing, i, *place, **more) for i, place in enumerate(PLACES)]


@pytest.fixture(scope="module")
def mug() -> Joint:
    """From the same captures as `enrolled(MUG, "mug", "body")`, which other tests share."""
    captures = [Named(f"mug{i}", item.spectra) for i, item in enumerate(three(MUG))]
    return joint.enroll_signature(captures, "mug", "body")


def test_an_object_is_found_where_it_stands(mug: Joint) -> None:
    """Rotation and shift against the first capture, whose pose is the signature's frame."""
    assert [round(r.energy / r.expected, 1) for r in mug.residuals] == pytest.approx([1, 1, 1], abs=0.35)
    assert mug.signature.model_error < 0.003
    base = mug.placed[0].pose
    for centre, rotation in ((0.003 + 0.006j, 1.0), (-0.007 - 0.002j, 5.5)):
        spectra = named(MUG, 9, centre, rotation, views=36).spectra
        matched = match(spectra, mug.signature)
        turn = rotation - PLACES[0][1]
        # The frame's centre is a point fixed to the object.
        expected = centre + (base.centre - PLACES[0][0]) * np.exp(1j * turn)
        off = np.angle(np.exp(1j * (matched.pose.turn_rad - base.turn_rad - turn)))
        assert abs(np.rad2deg(off)) < 0.5
        assert abs(matched.pose.centre - expected) < 4e-4
        assert matched.residual < 1.4 * spectra.noise_energy
        assert round_centre(spectra)[1] > 30 * spectra.noise_energy


def test_the_near_field_carries_a_signature_to_another_distance(
    mug: Joint, monkeypatch: pytest.MonkeyPatch
) -> None:
    spectra = named(MUG, 9, 0.002j, 1.0, views=36, distance=0.7).spectra
    turning = round_centre(spectra)[1]
    matched = match(spectra, mug.signature)
    assert matched.residual < 0.02 * turning
    monkeypatch.setattr(posing, "turned", _turned_wrong)
    assert match(spectra, mug.signature).residual > 3 * matched.residual


def _turned_wrong(spectra: Spectra, single: Signature, turn: float) -> np.ndarray:
    m = np.arange(-single.order, single.order + 1)
    wrong = signature.near_field(spectra.wavenumbers, single.order, -spectra.distance_m)
    return single.harmonics * wrong * np.exp(-1j * m * turn)


def test_the_search_by_transforms_equals_direct_projection(mug: Joint) -> None:
    spectra = named(MUG, 9, 0.003 + 0.003j, 1.0, views=36).spectra
    single = mug.signature
    best = PoseSearch(spectra, single.order + 4).candidates(single, 1)[0]
    thin = spectra.thinned(2)
    weights = replace(
        single, wavenumbers=single.wavenumbers[::2], harmonics=single.turning[::2], noise=single.noise[::2]
    )

    def left(pose: Pose) -> float:
        at = signature.Standpoint(thin, pose.centre)
        turned = signature.turned(thin, weights, pose.turn_rad)
        echo = at.carrier * (turned @ angular(at.azimuth, single.order).T)
        q = np.linalg.qr(np.stack([np.ones_like(echo), at.carrier, echo], axis=-1))[0]
        y = thin.data[..., None]
        return float(np.sum(np.abs(y - q @ (q.conj().swapaxes(1, 2) @ y)) ** 2))

    turns = 2 * np.pi * np.arange(posing.ROTATIONS) / posing.ROTATIONS
    direct = min(turns, key=lambda turn: left(Pose(best.centre_m, float(turn))))
    assert best.turn_rad == pytest.approx(direct)


def test_slopes_are_those_of_the_model(mug: Joint) -> None:
    spectra = named(MUG, 9, 0.001j, 1.0, views=36).spectra
    at, step = signature.Standpoint(spectra, 0.002 + 0.001j), 1e-7
    for axis, shift in enumerate((step, 1j * step)):
        there = signature.Standpoint(spectra, 0.002 + 0.001j + shift)
        assert np.allclose(at.carrier_slopes()[axis], (there.carrier - at.carrier) / step, atol=1e-3)
        assert np.allclose(at.azimuth_slopes()[axis], (there.azimuth - at.azimuth) / step, atol=1e-5)
    near = match(spectra, mug.signature)
    start = Pose((near.pose.centre_m[0] + 1e-3, near.pose.centre_m[1] - 1e-3), near.pose.turn_rad + 0.05)
    again = refine(spectra, mug.signature, start)
    assert again.residual == pytest.approx(near.residual, rel=1e-3)


def test_a_capture_of_a_changed_object_is_to_blame() -> None:
    captures = three(MUG.plus(TAG))
    changed = named(MUG, 7, *PLACES[1])
    with pytest.raises(DataError, match=r"^c7 does not show what the other captures"):
        enroll_signature([captures[0], changed, captures[2]], "mug-tag", "object")
    with pytest.raises(DataError, match="do not agree"):
        other = Thing((0.03j, -0.05), (3.0, 2.0), 1.0)
        enroll_signature([captures[0], changed, named(other, 8, *PLACES[2])], "mug-tag", "object")


def test_two_captures_of_something_else_are_both_to_blame() -> None:
    captures = [*three(MUG), named(MUG.plus(TAG), 6, 0.004j, 3.3)]
    other = named(Thing((0.03j, -0.05), (3.0, 2.0), 1.0), 8, *PLACES[2])
    blamed = r"^c(6 and c8|8 and c6) do not show what the other captures"
    with pytest.raises(DataError, match=blamed) as caught:
        enroll_signature([*captures, other], "mug", "body")
    assert "without a tag" in caught.value.remedy


@pytest.fixture(scope="module")
def tagged() -> Signature:
    return enrolled(MUG.plus(TAG), "mug-7", "object")


def stated_wrongly(true: Spectra, first_rad: float, second_rad: float, phase_rad: float) -> Spectra:
    """The same spectra with stated angles that are off once and twice a turn."""
    bearing = np.angle(true.antenna)
    errors = first_rad * np.sin(bearing + phase_rad) + second_rad * np.cos(2 * bearing - phase_rad)
    return replace(true, antenna=true.antenna * np.exp(-1j * errors))


def test_an_uneven_turn_is_read_off_the_object(tagged: Signature) -> None:
    """By a stated angle that is too small the antenna stands further round than the scans say."""
    true = aspect_spectra(capture(MUG.plus(TAG), 5, centre=0.004 - 0.004j, rotation=1.0, views=36))
    stated = stated_wrongly(true, 0.008, 0.004, 0.4)
    rigid = match(stated, tagged)
    result, stated_seen = steadied(stated, tagged, rigid.pose)
    even, true_seen = steadied(true, tagged, rigid.pose)
    for seen in (stated_seen, true_seen):
        assert np.abs(np.angle(seen.antenna / true.antenna)).max() < 2e-3
    assert abs(result.pose.centre - even.pose.centre) < 1e-5
    assert rigid.residual > 2.5 * result.residual
    assert abs(result.residual - even.residual) < 0.1 * even.residual
    _, noisy = steadied(replace(stated, noise=1e6 * true.noise), tagged, rigid.pose)
    assert np.abs(np.angle(noisy.antenna / stated.antenna)).max() < 1e-4


def test_captures_of_uneven_turns_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    rigid = enumerate(three(MUG.plus(TAG)))
    captures = [replace(c, spectra=stated_wrongly(c.spectra, 0.01, 0.004, 2.0 * i)) for i, c in rigid]
    agreed = estimate(captures, "mug-7", "object", 0.085)
    assert agreed.signature.model_error < 3e-4
    monkeypatch.setattr(joint, "UNEVEN_SHARE", 2.0)
    assert estimate(captures, "mug-7", "object", 0.085).signature.model_error > 1.5e-3


def test_an_oval_is_enrolled_in_poses_in_which_its_round_part_agrees() -> None:
    """What turns of it looks alike a quarter turn on, with the gain reversed: a capture was refused."""
    poses = (Pose((0.002, 0.0), 0.0), Pose((-0.002, 0.0035), 2.1), Pose((-0.003, -0.005), 4.0))
    captures = []
    for seed, pose in enumerate(poses):
        rng = np.random.default_rng([seed, 4])
        room, size = room_clutter(rng), ReflectorSpec("octahedron", 0.02)
        body, nowhere = parse_body("cup:36mm,wall=3.4mm,oval=0.2mm"), np.zeros((0, 2))
        scene = object_scene("oval", nowhere, body, size, rng=rng, room=room, variation=Variation(2.6))
        acquisition = Acquisition(views=72, snr_db=20.0, placement=Placement(pose.centre_m, pose.turn_rad))
        captures.append(Named(f"{seed}", aspect_spectra(simulate_capture(scene, acquisition, seed)[0])))
    result = enroll_signature(captures, "oval", "body")
    assert all(residual.is_noise for residual in result.residuals)
    turns = [item.pose.turn_rad - result.placed[0].pose.turn_rad for item in result.placed]
    # An oval looks the same after half a turn.
    off = np.angle(np.exp(2j * (np.array(turns) - [pose.turn_rad for pose in poses]))) / 2
    assert np.abs(np.rad2deg(off)).max() < 12


def test_gains_and_harmonics_are_improved_together(mug: Joint) -> None:
    """From gains far off, at the right poses, back to what the joint estimate leaves."""
    rng = np.random.default_rng(3)
    work = _Estimate([item.spectra for item in mug.placed], "mug", "body", mug.signature.radius_m)
    work.placed, basis = dict(enumerate(mug.placed)), work.basis
    best = _residual_energy(work.placed.values(), basis)
    off = 0.3 * rng.standard_normal((3, 2, len(basis.mask)))
    off[work.order[0]] = 0
    gains = 1 + off[:, 0] + 1j * off[:, 1]
    work.placed = {i: replace(item, gain=item.gain * gains[i]) for i, item in work.placed.items()}
    assert _residual_energy(work.placed.values(), basis) > 10 * best
    work.balance(8)
    assert _residual_energy(work.placed.values(), basis) < 1.02 * best


def test_captures_that_cannot_make_a_signature_are_refused() -> None:
    captures = three(MUG)
    with pytest.raises(DataError, match="needs 3"):
        enroll_signature(captures[:2], "mug", "body")
    still = [named(MUG, i, *PLACES[0]) for i in range(3)]
    with pytest.raises(DataError, match="same place"):
        enroll_signature(still, "mug", "body")
    nothing = Thing((), ())
    with pytest.raises(DataError, match="nothing but noise"):
        enroll_signature([named(nothing, i, *PLACES[i]) for i in range(3)], "mug", "body")


def test_the_order_holds_what_a_point_on_the_rim_returns() -> None:
    from scipy.special import jv

    for radius in (0.04, 0.055, 0.085, 0.12):
        for wavenumber in (134.0, 201.0):
            m = np.arange(-120, 121)
            energy = jv(m, wavenumber * radius) ** 2
            beyond = energy[np.abs(m) > order_of(wavenumber, radius)].sum()
            assert beyond < 0.02


def test_likeness_and_what_a_tag_must_return(mug: Joint) -> None:
    others = [named(MUG, 20 + i, c * 1j, r + 0.7) for i, (c, r) in enumerate(PLACES)]
    again = enroll_signature(others, "cup", "body").signature
    assert compare(mug.signature, again).alike
    assert 0.05 < mug.signature.turning_share < 0.9
    assert least_tag(mug.signature) < 0.01


@pytest.mark.parametrize(
    ("remaining", "turning", "moving", "noise"),
    [(1.39, 0.0, 0.0, True), (1.41, 0.0, 0.0, False), (2.1, 100.0, 100.0, True), (2.41, 0.7, 3447.0, True),
     (2.41, 0.7, 900.0, False)],
)  # fmt: skip
def test_a_capture_may_keep_a_little_of_what_turns_and_less_of_what_moves(
    remaining: float, turning: float, moving: float, noise: bool
) -> None:
    """A cup 35 dB over the noise was refused for 0.04 % of its echo."""
    residual = Residual("capture 1", remaining, 1.0, turning, moving)
    assert residual.is_noise == noise
    assert (residual.over <= 0) == noise
