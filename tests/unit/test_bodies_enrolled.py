"""Reading with enrolled bodies and objects, and what the registry keeps of them."""

from __future__ import annotations

import io
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies_synthetic import MUG, TAG, Thing, capture, ring
from numpy.typing import NDArray
from rich.console import Console

from tagid.cli.common.imaging import describe
from tagid.errors import FileFormatError, LayoutConflictError, RegistryError
from tagid.operate.turn import Answer
from tagid.operate.words import HYPOTHESES, hypothesis_words
from tagid.pipeline.answer import Identification
from tagid.pipeline.enrolment import propose_layout, propose_signature
from tagid.pipeline.identify import _looked_at_again, aspect_spectra, identify, without_body
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.tags.bodies import joint
from tagid.tags.bodies.enrolled import (
    EnrolledBody,
    EnrolledObject,
    Searches,
    hypotheses,
    signature_wavenumbers,
)
from tagid.tags.bodies.hypothesis import Explanation, Kind, Pose
from tagid.tags.bodies.joint import Named, enrol_signature, estimate
from tagid.tags.bodies.posing import match
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.signature import Signature, echo
from tagid.tags.bodies.signature_file import to_bytes
from tagid.tags.bodies.steadying import steadied
from tagid.tags.enrolling.layout_file import read_entries, write_layouts
from tagid.tags.enrolling.registry import Registry
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.contest import _contested
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.refused import attributed
from tagid.tags.verdicts.verdict import Code

GOLDEN = Path(__file__).parents[1] / "data" / "registry-v1.sqlite"
LAYOUTS = list(builtin_layouts().values())


def enrolled(thing: Thing, name: str, kind: str) -> Signature:
    places = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
    captures = [
        Named(f"{name}{i}", aspect_spectra(capture(thing, i, centre=centre, rotation=turn)))
        for i, (centre, turn) in enumerate(places)
    ]
    return enrol_signature(captures, name, kind).signature  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def mug() -> Signature:
    return enrolled(MUG, "mug", "body")


@pytest.fixture(scope="module")
def tagged() -> Signature:
    return enrolled(MUG.plus(TAG), "mug-7", "object")


def read(thing: Thing, *signatures: Signature, seed: int = 50) -> Identification:
    taken = capture(thing, seed, centre=0.004 - 0.004j, rotation=1.0, views=36)
    return identify(taken, LAYOUTS, None, 1, signatures)


def test_a_tag_on_an_enrolled_body_is_named(mug: Signature) -> None:
    answer = read(MUG.plus(TAG), mug)
    reading = answer.reading
    assert answer.status == "identified" and reading is not None
    assert (reading.layout, reading.kind) == ("container-90", Kind.BODY)
    on_mug = next(one for one in reading.hypotheses if one.kind is Kind.BODY)
    assert on_mug.name == "mug" and on_mug.left < 0.01
    assert read(MUG.plus(TAG)).status != "identified"


def test_an_untagged_body_and_another_tag_are_not_named(mug: Signature) -> None:
    assert read(MUG, mug).status == "no_tag"
    for other in (ring(10, 150), ring(200)):
        assert read(MUG.plus(other), mug).status in ("unknown", "ambiguous", "no_tag")


def test_an_enrolled_body_with_another_tag_contradicts_a_name_without_a_body(mug: Signature) -> None:
    """The mug has no wall that shows here: that it is the enrolled one is what counts."""
    answer = read(MUG.plus(ring(10, 150)), mug)
    reading = answer.reading
    assert reading is not None and reading.body is not None and reading.body.body.name == "mug"
    seen = replace(reading.body, front_m=0.0, body_energy=0.0)
    own = Explanation(Kind.BARE, "", "container-90", 0.2, None, Pose())
    evidence = replace(reading.evidence, outward=0.0)
    bare = replace(reading, status="identified", layout="container-90", kind=Kind.BARE, evidence=evidence)
    taken = _contested(bare, own, seen, LAYOUTS, ContestSettings())
    assert (taken.status, taken.layout, taken.code) == ("unknown", None, Code.OTHER)
    assert (
        _contested(bare, own, replace(seen, body=RoundBody()), LAYOUTS, ContestSettings()).layout
        == bare.layout
    )


def test_an_enrolled_object_is_named_as_a_whole(mug: Signature, tagged: Signature) -> None:
    answer = read(MUG.plus(TAG), tagged)
    reading = answer.reading
    assert answer.status == "identified" and reading is not None
    assert (reading.layout, reading.kind) == ("mug-7", Kind.OBJECT)
    with_body = read(MUG.plus(TAG), mug, tagged)
    assert with_body.reading is not None and with_body.reading.layout == "mug-7"
    for other in (MUG, MUG.plus(ring(100)), MUG.plus(ring(100, 280))):
        answer = read(other, tagged)
        assert answer.status != "identified" or answer.reading.layout != "mug-7"  # type: ignore[union-attr]
    twin = replace(tagged, name="mug-8")
    assert read(MUG.plus(TAG), tagged, twin).status == "ambiguous"


def test_an_enrolled_object_lists_the_reflectors_measured_on_its_body(
    mug: Signature, tagged: Signature
) -> None:
    """They are those of the reading on the body that was fitted beside it."""
    reading = read(MUG.plus(TAG), mug, tagged).reading
    assert reading is not None and reading.kind is Kind.OBJECT
    assert reading.body is not None and reading.body.body.name == "mug"
    places = np.array([0.004 - 0.004j + point * np.exp(1j) for point in TAG.points])
    found = np.array([complex(one.x_m, one.y_m) for one in reading.reflectors])
    assert len(found) == 2 and all(one.matched for one in reading.reflectors)
    assert np.abs(found[:, None] - places).min(axis=1).max() < 0.003
    # Without the mug one reflector stands for its handle: the wall is fitted, and nothing is listed.
    alone = read(MUG.plus(TAG), tagged).reading
    assert alone is not None and alone.kind is Kind.OBJECT and alone.reflectors == ()
    assert alone.body is not None and alone.body.body.name == ""


def test_the_picture_of_an_enrolled_object_goes_without_its_body(mug: Signature, tagged: Signature) -> None:
    taken = capture(MUG.plus(TAG), 50, centre=0.004 - 0.004j, rotation=1.0, views=36)
    answer = identify(taken, LAYOUTS, None, 1, (mug, tagged))
    shown = without_body(PreparedCapture(taken, ImagingSettings()), answer).given

    def moving(samples: NDArray[np.floating]) -> float:
        return float(((samples - samples.mean(axis=0)) ** 2).sum())

    tag = moving(capture(TAG, 50, centre=0.004 - 0.004j, rotation=1.0, views=36).samples)
    assert moving(taken.samples) > 5 * tag and moving(shown.samples) < 1.3 * tag


@pytest.mark.parametrize("seed", [50, 51])
def test_a_refused_tag_on_a_round_body_is_attributed_to_it(seed: int) -> None:
    """Points on the wall explain most of its echo, but the body with reflectors far more."""
    odd = ring(0, 71, 207)
    reading = read(Thing((), (), wall=20.0).plus(odd), seed=seed).reading
    assert reading is not None and (reading.status, reading.kind) == ("unknown", Kind.ROUND)
    assert reading.code is Code.MISSING  # what points without a body are refused for
    places = np.array([0.004 - 0.004j + point * np.exp(1j) for point in odd.points])
    found = np.array([complex(one.x_m, one.y_m) for one in reading.reflectors])
    assert len(found) == 3 and np.abs(found[:, None] - places).min(axis=1).max() < 0.003
    won = reading.explained_by
    assert won is not None and won.kind is Kind.ROUND and won.left < 0.02


def test_a_refusal_is_not_attributed_to_a_body_that_alone_explains_little() -> None:
    reading = read(ring(0, 71, 207)).reading
    assert reading is not None and reading.status == "unknown" and reading.body is not None
    bare = replace(reading, kind=Kind.BARE)
    assert attributed(bare, ContestSettings()) is bare


def test_the_image_is_looked_at_without_the_body(mug: Signature) -> None:
    """In that of the whole mug the network sees its handle, and none of the reflectors."""
    answer = read(MUG.plus(TAG), mug)
    assert answer.second is not None and answer.second.disagrees == ""
    assert min(one.probability for one in answer.second.opinions) > 0.5
    assert answer.to_dict()["note"] == ""


def test_the_answer_says_where_the_image_contradicts_a_name() -> None:
    named = read(TAG).reading
    assert named is not None and named.status == "identified" and named.note == ""
    where = {"centre": 0.004 - 0.004j, "rotation": 1.0, "views": 36}
    elsewhere = PreparedCapture(capture(ring(10, 280), 50, **where))  # type: ignore[arg-type]
    reading, second = _looked_at_again(elsewhere, replace(named, note="first"))
    assert second is not None and reading.layout == named.layout
    assert reading.note == "first; the image does not show its reflectors"
    # The screen shows it without being asked.
    printed = io.StringIO()
    answer = Identification(reading.status, reading, None, 1, second=second)
    Console(file=printed, width=80).print(describe(Answer(answer), "x.h5", verbose=False))
    lines = printed.getvalue().splitlines()
    assert lines[0] == "CONTAINER-90   x.h5" and lines[1].startswith(("  at most 1 in ", "  no bound"))
    assert lines[2:] == ["  caution: first; the image does not show its reflectors"]
    more = PreparedCapture(capture(TAG.plus(ring(325)), 50, **where))  # type: ignore[arg-type]
    assert "that it does not have" in _looked_at_again(more, named)[0].note
    refused = replace(named, status="unknown")
    assert _looked_at_again(elsewhere, refused)[0] is refused


def test_the_hypothesis_that_won_is_put_in_words(mug: Signature, tagged: Signature) -> None:
    """Its body's centre and what it leaves, for names and refusals alike, on one line of 80 columns."""

    def words(thing: Thing, *signatures: Signature) -> str:
        reading = read(thing, *signatures).reading
        assert reading is not None
        return hypothesis_words(reading)

    assert words(MUG.plus(TAG), mug) == "a tag on the body mug, centre (1, -3) mm, 0.0 % unexplained"
    assert words(MUG, mug) == "the body mug without a tag, centre (1, -3) mm, 0.0 % unexplained"
    assert words(MUG.plus(TAG), tagged) == "an enrolled object, centre (1, -3) mm, 0.0 % unexplained"
    refused = words(Thing((), (), wall=20.0).plus(ring(0, 71, 207)))
    assert refused == "a tag on a round body, centre (3, -4) mm, 0.6 % unexplained"
    # A name states the centre of its layout; without a body there is no other.
    assert words(TAG) == "a tag without a body, 1.2 % unexplained"
    longest = max(HYPOTHESES.values(), key=len)
    assert len(f"  read as: {longest}, centre (-12, -12) mm, 9.9 % unexplained") <= 80


@pytest.mark.parametrize("seed", [50, 51, 52])
def test_a_weak_reflector_that_an_object_lacks_shows_in_noise(tagged: Signature, seed: int) -> None:
    """Its energy is less than the error of the level of the noise, but it stands in one place."""

    def named(thing: Thing) -> bool:
        taken = capture(thing, seed, centre=0.004 - 0.004j, rotation=1.0, views=36, noise=0.5)
        reading = identify(taken, LAYOUTS, None, 1, (tagged,)).reading
        return reading is not None and reading.layout == "mug-7"

    assert named(MUG.plus(TAG))
    assert not named(MUG.plus(TAG).plus(ring(320, amplitude=0.5)))


def test_the_strongest_reflector_left_is_found_where_it_stands(tagged: Signature) -> None:
    model = EnrolledObject(tagged, Searches(tagged.order))
    for extra, noise in ((ring(320), 0.1), (ring(250, radius=0.06), 0.5)):
        more = capture(MUG.plus(TAG).plus(extra), 4, centre=0.004 - 0.004j, rotation=1.0, noise=noise)
        spectra = aspect_spectra(more)
        stray = model.stray(model.match(spectra))
        place = 0.004 - 0.004j + extra.points[0] * np.exp(1j)
        assert stray.nats > 30 and abs(complex(*stray.place_m) - place) < 0.012
        same = aspect_spectra(capture(MUG.plus(TAG), 4, centre=0.004 - 0.004j, rotation=1.0, noise=noise))
        assert model.stray(model.match(same)).nats < 20


def test_an_uneven_turn_is_read_off_the_object(tagged: Signature) -> None:
    """By a stated angle that is too small the antenna stands further round than the scans say."""
    true = aspect_spectra(capture(MUG.plus(TAG), 5, centre=0.004 - 0.004j, rotation=1.0, views=36))
    bearing = np.angle(true.antenna)
    errors = 0.008 * np.sin(bearing + 0.4) + 0.004 * np.cos(2 * bearing)
    stated = replace(true, antenna=true.antenna * np.exp(-1j * errors))
    rigid = match(stated, tagged)
    found, even = steadied(stated, tagged, rigid.pose), steadied(true, tagged, rigid.pose)
    for one in (found, even):
        assert np.abs(np.angle(one.spectra.antenna / true.antenna)).max() < 2e-3
    assert abs(found.pose.centre - even.pose.centre) < 1e-5
    assert rigid.left > 2.5 * found.left
    assert abs(found.left - even.left) < 0.1 * even.left
    noisy = steadied(replace(stated, noise=1e6 * true.noise), tagged, rigid.pose)
    assert np.abs(np.angle(noisy.spectra.antenna / stated.antenna)).max() < 1e-4


def test_captures_of_uneven_turns_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = []
    for i, (centre, turn) in enumerate(
        ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
    ):
        true = aspect_spectra(capture(MUG.plus(TAG), i, centre=centre, rotation=turn))
        errors = 0.01 * np.sin(np.angle(true.antenna) + 2.0 * i) + 0.004 * np.sin(
            2 * np.angle(true.antenna) - i
        )
        captures.append(Named(f"c{i}", replace(true, antenna=true.antenna * np.exp(-1j * errors))))
    agreed = estimate(captures, "mug-7", "object", 0.085)
    assert agreed.signature.model_error < 3e-4
    monkeypatch.setattr(joint, "UNEVEN_SHARE", 2.0)
    assert estimate(captures, "mug-7", "object", 0.085).signature.model_error > 1.5e-3


def test_a_bare_pair_whose_centre_lies_far_off_the_axis_is_not_named() -> None:
    """Two reflectors 69 degrees apart on 56 mm have the spacing of the pair 90 degrees apart on 45 mm."""
    half = np.rad2deg(np.arcsin(0.045 / np.sqrt(2) / 0.056))
    for thing, status in ((ring(76, 76 + 2 * half, radius=0.056), "unknown"), (TAG, "identified")):
        reading = identify(capture(thing, 1, centre=0.003 + 0.002j, views=36), LAYOUTS, None, 1).reading
        assert reading is not None and reading.status == status
        assert (reading.code is Code.OFF_CENTRE) == (status == "unknown")


def test_signatures_of_another_band_take_no_part(tagged: Signature) -> None:
    other = replace(tagged, wavenumbers=tagged.wavenumbers * 1.2)
    assert hypotheses([other], signature_wavenumbers(3.95e9, 1.7e9)).objects == ()
    assert read(MUG.plus(TAG), other).status != "identified"


def test_a_body_as_hypothesis_is_its_echo_at_any_frequencies(mug: Signature) -> None:
    spectra = aspect_spectra(capture(MUG, 3, views=36))
    body = EnrolledBody(mug, Searches(mug.order))
    pose = Pose((0.003, -0.002), 0.8)
    there = body.echo(spectra, np.array([0j, pose.centre]), np.array([0.0, pose.turn_rad]))
    assert np.allclose(there[1], echo(spectra, mug, pose))
    coarse = body.echo(spectra.thinned(2), np.array([pose.centre]), np.array([pose.turn_rad]))
    assert np.allclose(coarse[0], there[1][::2])
    assert body.turns and not replace(body, signature=replace(mug, noise=mug.noise * 1e6)).turns


def test_a_registry_of_schema_1_is_migrated(tmp_path: Path, mug: Signature) -> None:
    path = tmp_path / "registry.sqlite"
    shutil.copy(GOLDEN, path)
    registry = Registry(path)
    assert registry.version == 9 and registry.signatures() == []
    names = [layout.name for layout in registry.layouts()]
    assert names == ["container-90", "helmet-120", "helmet-linear", "mine"]
    assert registry.get("mine").sigma_m == pytest.approx(1e-3)
    assert {change.kind for change in registry.history()} == {"layout"}
    assert all(change.layout is not None for change in registry.history())
    assert registry.add_all([], "3 captures", signatures=[mug]) == 10
    assert registry.undo(6).version == 12
    assert registry.signatures() == [] and "container-180" in [one.name for one in registry.layouts()]
    with sqlite3.connect(path) as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] == 2
    connection.close()


def test_bodies_and_objects_are_kept_undone_and_removed(
    tmp_path: Path, mug: Signature, tagged: Signature
) -> None:
    registry = Registry(tmp_path / "r.db")
    layout = Layout("mug-7", np.array([[0.045, 0], [0, 0.045]]))
    assert registry.add_all([layout], "3 captures", signatures=[tagged], replace=False) == 6
    assert registry.add_all([], "3 captures", signatures=[mug], replace=False) == 7
    assert registry.add_all([], "again", signatures=[mug]) == 7
    with pytest.raises(RegistryError, match="a body named mug is already enrolled"):
        registry.add_all([], "x", signatures=[mug], replace=False)
    assert [(one.kind, one.name) for one in registry.contents().signatures] == [
        ("body", "mug"),
        ("object", "mug-7"),
    ]
    assert to_bytes(registry.signature("body", "mug")) == to_bytes(mug)
    assert registry.remove_signature("body", "mug") == 8
    with pytest.raises(RegistryError, match="no body is named 'mug'"):
        registry.remove_signature("body", "mug")
    assert registry.undo().version == 9
    assert [one.name for one in registry.signatures("body")] == ["mug"]
    # An identity goes as a whole and comes back as a whole.
    assert registry.remove("mug-7") == 11
    assert registry.signatures("object") == []
    registry.undo()
    assert [one.name for one in registry.signatures("object")] == ["mug-7"]
    assert registry.get("mug-7").size == 2
    last = registry.history("mug")[-1]
    assert last.kind == "body" and isinstance(last.entry, Signature)


def test_alike_objects_enrolled_at_once_are_seen(tmp_path: Path, tagged: Signature) -> None:
    registry = Registry(tmp_path / "r.db")
    before = registry.contents()
    one, two = (replace(tagged, name=name) for name in ("one", "two"))
    first, second = propose_signature(before, one), propose_signature(before, two)
    assert first.conflict is None and second.conflict is None
    late = propose_layout(before, Layout("one", np.array([[0.08, 0], [0, 0.05]])), None, True)
    first.store(registry, "process 1")
    with pytest.raises(LayoutConflictError, match="two could be confused with one"):
        second.store(registry, "process 2")
    with pytest.raises(RegistryError, match="an object named one is already enrolled"):
        late.store(registry, "process 3")
    with pytest.raises(RegistryError, match="an object named one is already enrolled"):
        propose_signature(before, one).store(registry, "process 4")
    assert second.store(registry, "process 2", force=True) == registry.version == 6
    with pytest.raises(RegistryError, match="a layout named helmet-120 is already enrolled"):
        propose_signature(before, replace(tagged, name="helmet-120")).store(registry, "process 5")


def test_a_damaged_signature_is_seen_and_can_be_removed(tmp_path: Path, mug: Signature) -> None:
    registry = Registry(tmp_path / "r.db")
    registry.add_all([], "3 captures", signatures=[mug])
    good = registry.version
    data = bytearray(to_bytes(mug))
    data[len(data) // 2] ^= 1
    connection = sqlite3.connect(registry.path, isolation_level=None)
    for wrong in (bytes(data), b"", "text", 7, to_bytes(replace(mug, name="other"))):
        connection.execute("UPDATE signature SET data = ?", (wrong,))
        with pytest.raises(RegistryError, match="damaged signature of the body 'mug'") as caught:
            registry.contents()
        assert "bodies --remove" in caught.value.remedy
    connection.close()
    assert len(registry.layouts()) == 4
    registry.remove_signature("body", "mug")
    assert registry.history("mug")[-1].entry is None
    registry.undo(good)
    assert [one.name for one in registry.signatures()] == ["mug"]


def test_files_carry_signatures(tmp_path: Path, mug: Signature, tagged: Signature) -> None:
    path = tmp_path / "all.toml"
    write_layouts(LAYOUTS, path, [mug, tagged])
    entries = read_entries(path)
    assert [to_bytes(one) for one in entries.signatures] == [to_bytes(mug), to_bytes(tagged)]
    assert [one.to_dict() for one in entries.layouts] == [one.to_dict() for one in LAYOUTS]
    write_layouts([], path, [mug])
    assert read_entries(path).layouts == ()
    text = path.read_text("utf-8")
    for wrong in (text.replace('data = "VEFH', 'data = "AEFH'), text.replace('data = "', 'data = "*')):
        path.write_text(wrong, "utf-8")
        with pytest.raises(FileFormatError, match="signature 1"):
            read_entries(path)
    write_layouts(LAYOUTS, path)
    assert "version = 1" in path.read_text("utf-8")
