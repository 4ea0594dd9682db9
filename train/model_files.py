"""Writing the graphs that the package ships, with their entries in the manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tagid import interrupts
from tagid._version import __version__
from tagid.files import write_bytes
from tagid.models_store import FOLDER, MANIFEST_VERSION, OPSET, ModelEntry, Tensor, manifest


def write_entry(entry: ModelEntry, content: bytes, folder: Path = FOLDER) -> None:
    """Add a model and its manifest entry to a folder, replacing one of the same name."""
    path = folder / "manifest.json"
    data: dict[str, Any] = {"manifest_version": MANIFEST_VERSION, "models": {}}
    if path.exists():
        data["models"] = {name: _json(old) for name, old in manifest(folder).items()}
    data["models"][entry.name] = _json(entry)
    with interrupts.deferred():
        write_bytes(folder / entry.file, content)
        write_bytes(path, (json.dumps(data, indent=1, sort_keys=True) + "\n").encode())
    manifest.cache_clear()


def _json(entry: ModelEntry) -> dict[str, Any]:
    """The value of an entry in the manifest, where its name is the key."""
    return {name: value for name, value in asdict(entry).items() if name != "name"}


def strip(model: Any) -> None:
    """Take out of an exported graph what the exporter says of itself and of this computer."""
    graph = model.graph
    del graph.value_info[:]
    for part in (model, graph, *graph.node, *graph.input, *graph.output):
        part.ClearField("metadata_props")
    for node in graph.node:
        node.ClearField("doc_string")
    model.producer_name, model.producer_version = "tagid", __version__


def entry_of(
    name: str,
    content: bytes,
    inputs: Mapping[str, Tensor],
    outputs: Mapping[str, Tensor],
    facts: Mapping[str, Any],
) -> ModelEntry:
    """The manifest entry of a graph with these inputs and outputs."""
    digest = hashlib.sha256(content).hexdigest()
    return ModelEntry(name, f"{name}.onnx", digest, len(content), OPSET, inputs, outputs, facts)
