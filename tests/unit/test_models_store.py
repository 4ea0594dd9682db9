"""Shipped models: whatever is not what the manifest says is refused, with both values in the message."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tagid import models_store
from tagid.errors import ModelError, StorageError
from tagid.models_store import FOLDER, OPSET, manifest, model_bytes, open_model


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the shipped folder, to be damaged."""
    copy = tmp_path / "models"
    shutil.copytree(FOLDER, copy)
    return copy


def change(folder: Path, name: str, **facts: object) -> None:
    path = folder / "manifest.json"
    result = json.loads(path.read_text())
    result["models"][name].update(facts)
    path.write_text(json.dumps(result))
    manifest.cache_clear()


def test_everything_shipped_is_what_the_manifest_says() -> None:
    models_store.check_all()
    for name, entry in manifest().items():
        content, _ = model_bytes(name)
        assert len(content) == entry.size < 2**24
        assert entry.opset == OPSET
        assert open_model(name).entry == entry


def test_a_changed_or_cut_file_is_refused_naming_both_hashes_or_sizes(folder: Path) -> None:
    path, entry = folder / "ats_step.onnx", manifest()["ats_step"]
    content = bytearray(path.read_bytes())
    path.write_bytes(content[:1000])
    with pytest.raises(ModelError, match=rf"1000 bytes, the manifest says {entry.size}"):
        open_model("ats_step", folder=folder)
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ModelError) as caught:
        model_bytes("ats_step", folder)
    assert entry.sha256 in caught.value.message and caught.value.remedy
    assert models_store.hashlib.sha256(content).hexdigest() in caught.value.message


def test_another_schema_or_opset_is_refused_naming_both(folder: Path) -> None:
    inputs = json.loads((folder / "manifest.json").read_text())["models"]["ats_step"]["inputs"]
    inputs["numbers"]["shape"] = [9]
    change(folder, "ats_step", inputs=inputs)
    with pytest.raises(ModelError, match=r"numbers is .*\(7,\).*manifest says .*\(9,\)"):
        open_model("ats_step", folder=folder)
    change(folder, "ats_step", opset=OPSET - 1)
    with pytest.raises(ModelError, match=f"opset {OPSET - 1}, expected {OPSET}"):
        open_model("ats_step", folder=folder)


def test_inputs_of_another_shape_are_refused_naming_both() -> None:
    model = open_model("ats_step")
    sizes: dict[str, int] = {}
    feeds = {
        name: np.zeros(
            [d if isinstance(d, int) else sizes.setdefault(d, 4 + len(sizes)) for d in t.shape], t.dtype
        )
        for name, t in model.entry.inputs.items()
    }
    model.check(feeds)
    with pytest.raises(ModelError, match=r"real is float32\[3, 5\], expected float32\['views', 'parts'\]"):
        model.check({**feeds, "real": np.zeros((3, 5), np.float32)})
    with pytest.raises(ModelError, match="float64"):
        model.check({**feeds, "numbers": np.zeros(9)})
    with pytest.raises(ModelError, match="numbers"):
        model.check({name: a for name, a in feeds.items() if name != "numbers"})


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"manifest_version": 2, "models": {}}', '{"manifest_version": 1}']
)
def test_a_manifest_that_is_none_is_refused(folder: Path, text: str) -> None:
    (folder / "manifest.json").write_text(text)
    manifest.cache_clear()
    with pytest.raises(ModelError, match=r"manifest\.json"):
        manifest(folder)


def test_a_file_outside_the_folder_or_missing_is_refused(folder: Path) -> None:
    change(folder, "ats_step", file="../manifest.json")
    with pytest.raises(ModelError, match="plain name"):
        model_bytes("ats_step", folder)
    change(folder, "ats_step", file="gone.onnx")
    with pytest.raises(StorageError, match=r"gone\.onnx"):
        model_bytes("ats_step", folder)
    with pytest.raises(ModelError, match="known are: ats_step"):
        model_bytes("another", folder)
