"""What is kept of signatures, in a registry, in files, as bytes, and what a new one is compared with."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies_synthetic import MUG, TAG, enrolled

from tagid.enrolling.enrollment import Basis
from tagid.enrolling.layout_file import read_entries, write_layouts
from tagid.enrolling.registry import Registry, RegistryContents
from tagid.errors import DataError, FileFormatError, LayoutConflictError, RegistryError, UsageError
from tagid.pipeline.enrollment import propose_layout, propose_signature
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.bodies.signature_file import MAX_BYTES, from_bytes, to_bytes
from tagid.tags.layouts.layout import Layout, builtin_layouts

GOLDEN = Path(__file__).parents[1] / "data" / "registry-v1.sqlite"
LAYOUTS = list(builtin_layouts().values())


@pytest.fixture(scope="module")
def mug() -> Signature:
    return enrolled(MUG, "mug", "body")


@pytest.fixture(scope="module")
def tagged() -> Signature:
    return enrolled(MUG.plus(TAG), "mug-7", "object")


def test_a_signature_is_stored_as_bytes_and_any_damage_is_seen(mug: Signature) -> None:
    data = to_bytes(mug)
    assert len(data) < 10_000 < MAX_BYTES
    back = from_bytes(data, "here")
    assert (back.name, back.kind, back.captures) == ("mug", "body", 3)
    assert np.allclose(back.harmonics, mug.harmonics, rtol=1e-6)
    assert to_bytes(back) == data
    rng = np.random.default_rng(1)
    for place in rng.integers(0, len(data), 60):
        broken = bytearray(data)
        broken[place] ^= 1 << int(rng.integers(0, 8))
        with pytest.raises(FileFormatError, match="here"):
            from_bytes(bytes(broken), "here")
    for cut in (0, 7, 40, len(data) - 1):
        with pytest.raises(FileFormatError, match="wrong length"):
            from_bytes(data[:cut] if cut < 41 else data + bytes(MAX_BYTES), "here")


@pytest.mark.parametrize(
    "change",
    [{"harmonics": np.full((9, 7), np.nan + 0j)}, {"harmonics": np.zeros((9, 7), complex)},
     {"harmonics": np.ones((9, 6), complex)}, {"noise": -np.ones(9)}, {"radius_m": 3.0},
     {"distance_m": 0.0}, {"model_error": 2.0}, {"wavenumbers": np.arange(9.0)[::-1]}],
)  # fmt: skip
def test_impossible_signatures_are_refused(mug: Signature, change: dict[str, object]) -> None:
    with pytest.raises(DataError, match="mug"):
        replace(mug, **change)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="not valid"):
        replace(mug, name="../mug")


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
    assert registry.signatures() == [] and "container-180" in [layout.name for layout in registry.layouts()]
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone()[0] == 2


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
    kept = [(signature.kind, signature.name) for signature in registry.contents().signatures]
    assert kept == [("body", "mug"), ("object", "mug-7")]
    assert to_bytes(registry.signature("body", "mug")) == to_bytes(mug)
    assert registry.remove_signature("body", "mug") == 8
    with pytest.raises(RegistryError, match="no body is named 'mug'"):
        registry.remove_signature("body", "mug")
    assert registry.undo().version == 9
    assert [signature.name for signature in registry.signatures("body")] == ["mug"]
    # An identity goes as a whole and comes back as a whole.
    assert registry.remove("mug-7") == 11
    assert registry.signatures("object") == []
    registry.undo()
    assert [signature.name for signature in registry.signatures("object")] == ["mug-7"]
    assert registry.get("mug-7").size == 2
    last = registry.history("mug")[-1]
    assert last.kind == "body" and isinstance(last.entry, Signature)


def test_alike_objects_enrolled_at_once_are_seen(tmp_path: Path, tagged: Signature) -> None:
    registry = Registry(tmp_path / "r.db")
    before = registry.contents()
    single, two = (replace(tagged, name=name) for name in ("one", "two"))
    first, second = propose_signature(before, single), propose_signature(before, two)
    assert first.conflict is None and second.conflict is None
    late = propose_layout(before, Layout("one", np.array([[0.08, 0], [0, 0.05]])), None, Basis())
    first.store(registry, "process 1")
    with pytest.raises(LayoutConflictError, match="two could be confused with one"):
        second.store(registry, "process 2")
    with pytest.raises(RegistryError, match="an object named one is already enrolled"):
        late.store(registry, "process 3")
    with pytest.raises(RegistryError, match="an object named one is already enrolled"):
        propose_signature(before, single).store(registry, "process 4")
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
        assert "bodies remove" in caught.value.remedy
    connection.close()
    assert len(registry.layouts()) == 4
    registry.remove_signature("body", "mug")
    assert registry.history("mug")[-1].entry is None
    registry.undo(good)
    assert [signature.name for signature in registry.signatures()] == ["mug"]


def test_files_carry_signatures(tmp_path: Path, mug: Signature, tagged: Signature) -> None:
    path = tmp_path / "all.toml"
    write_layouts(LAYOUTS, path, [mug, tagged])
    entries = read_entries(path)
    assert [to_bytes(signature) for signature in entries.signatures] == [to_bytes(mug), to_bytes(tagged)]
    assert [layout.to_dict() for layout in entries.layouts] == [layout.to_dict() for layout in LAYOUTS]
    write_layouts([], path, [mug])
    assert read_entries(path).layouts == ()
    text = path.read_text("utf-8")
    for wrong in (text.replace('data = "VEFH', 'data = "AEFH'), text.replace('data = "', 'data = "*')):
        path.write_text(wrong, "utf-8")
        with pytest.raises(FileFormatError, match="signature 1"):
            read_entries(path)
    write_layouts(LAYOUTS, path)
    assert "version = 1" in path.read_text("utf-8")


WAVENUMBERS = 2 * np.pi / 0.0385 * np.linspace(0.9, 1.1, 6)


def drawn(name: str, changed: float, kind: SignatureKind = "object") -> Signature:
    """An echo of random harmonics, of which a share is that of another object."""
    mine, other = (
        np.random.default_rng(seed).standard_normal((6, 17, 2)) @ (1, 1j) for seed in (1, len(name))
    )
    echo = np.sqrt(1 - changed) * mine + np.sqrt(changed) * other
    return Signature(name, kind, WAVENUMBERS, echo, np.full(6, 1e-3), 0.08, 1.0)


def test_the_most_similar_object_is_shown_first_and_a_confusable_one_refused() -> None:
    enrolled = [drawn("unlike-it", 1.0), drawn("twin", 0.005), drawn("cousin", 0.3)]
    proposal = propose_signature(RegistryContents(4, [], enrolled), drawn("new", 0.0))
    assert [likeness.second for likeness in proposal.likenesses] == ["twin", "cousin", "unlike-it"]
    assert proposal.alike == ("twin",)
    assert "confused with twin" in proposal.conflict.message
    apart = propose_signature(RegistryContents(4, [], enrolled[::2]), drawn("new", 0.0))
    assert apart.conflict is None and apart.taken is None


@pytest.mark.parametrize("name", ["twin", "helmet-120"])
def test_a_name_of_an_object_or_a_layout_is_taken_but_one_of_a_body_is_not(name: str) -> None:
    bodies = [drawn("can", 0.0, "body")]
    contents = RegistryContents(4, list(builtin_layouts().values()), [drawn("twin", 0.5), *bodies])
    assert propose_signature(contents, drawn(name, 0.0)).taken is not None
    assert propose_signature(contents, drawn("can", 0.0)).taken is None
