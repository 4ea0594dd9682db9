"""The optimisation step as an ONNX graph: what torch runs in the laboratory, onnxruntime runs in the field.

Run `python -m train.ats_step` in a checkout with the extra `export` to rewrite `models/`.
"""

from __future__ import annotations

import itertools
from typing import Any

import torch

from tagid.imaging.ats.fit_native import MODEL, parameter_names, state_names
from tagid.imaging.ats.fit_torch import Step, optimise
from tagid.imaging.ats.settings import LEVELS
from tagid.models_store import FOLDER, OPSET, ModelEntry, Tensor
from train.model_files import entry_of, strip, write_entry


class _Module(torch.nn.Module):  # type: ignore[misc]
    """`optimise` with its lists as arguments of their own, as the exporter wants them."""

    def forward(self, *parts: Any) -> Any:
        """Parts in the order of `Step`."""
        return optimise(Step(*parts))


def export_step() -> tuple[bytes, ModelEntry]:
    """The graph with named, dynamic dimensions, and its manifest entry."""
    import onnx

    parts = _example()
    shapes = [_dynamic(part) for part in parts]
    with torch.no_grad():
        program = torch.export.export(_Module(), tuple(parts), dynamic_shapes={"parts": tuple(shapes)})
    names = input_names()
    outputs = ["loss", *state_names()]
    exported = torch.onnx.export(
        program, dynamo=True, opset_version=OPSET, input_names=names, output_names=outputs, verbose=False
    )
    graph = exported.model_proto
    tensors = dimensions()
    for side in (graph.graph.input, graph.graph.output):
        for value in side:
            _rename(value, tensors[value.name])
    strip(graph)
    onnx.checker.check_model(graph, full_check=True)
    content = graph.SerializeToString(deterministic=True)
    facts = {
        "purpose": "one step of analysis through synthesis: field, forward model, gradient, Adam",
        "source": "tagid/imaging/ats/fit_torch.py",
        "levels": LEVELS,
        "hidden": 1,
    }
    sides = [{name: tensors[name] for name in side} for side in (names, outputs)]
    return content, entry_of(MODEL, content, sides[0], sides[1], facts)


def input_names() -> list[str]:
    """Names of the graph's inputs, in the order of `Step`."""
    state = [f"{prefix}{name}" for prefix in ("", "first_", "second_") for name in parameter_names()]
    grid = [f"interpolation_{i}" for i in range(LEVELS)]
    rest = ("support", "index", "real", "imaginary", "transmission", "spread", "samples", "confidence")
    return [*state, *grid, *rest, "numbers"]


def dimensions() -> dict[str, Tensor]:
    """Dtype and named shape of every input and output of the graph."""
    table = [("features", f"vertices_{i}", f"vertices_{i}") for i in range(LEVELS)]
    layers = (("width", "inputs"), ("parts", "width"))
    state: list[tuple[int | str, ...]] = [*table, *layers, ("width", 1), ("parts", 1)]
    shapes: list[tuple[int | str, ...]] = [*state * 3]
    shapes += [("pixels", f"vertices_{i}") for i in range(LEVELS)]
    shapes += [(1, "points"), ("views", "points"), ("views", "parts"), ("views", "parts")]
    shapes += [("seen_views", "seen_points")]
    shapes += [("fine", "spread"), (2, "views", "bins"), ("views", "bins"), (7,)]
    kinds = {"index": "int32"}
    tensors = {
        name: Tensor(kinds.get(name, "float32"), shape)
        for name, shape in zip(input_names(), shapes, strict=True)
    }
    tensors["loss"] = Tensor("float32", (1,))
    tensors |= {name: Tensor("float32", shape) for name, shape in zip(state_names(), state * 3, strict=True)}
    return tensors


def _example() -> list[Any]:
    """Arguments of one step, every dynamic size another one so that none is taken for another."""
    pixels, views, bins, fine, features, width, parts = 11, 7, 13, 97, 5, 6, 8
    vertices = [4 + 3 * i for i in range(LEVELS)]
    layers = [features * LEVELS, width, parts]
    tables = [torch.zeros(features, n, n) for n in vertices]
    weights = [torch.zeros(b, a) for a, b in itertools.pairwise(layers)]
    biases = [torch.zeros(b, 1) for b in layers[1:]]
    moments = [[torch.zeros_like(p) for p in (*tables, *weights, *biases)] for _ in range(2)]
    grid = [torch.zeros(pixels, n) for n in vertices]
    rest: list[tuple[int, ...]] = [(views, parts), (views, parts), (views, pixels**2), (fine, 2 * bins)]
    rest += [(2, views, bins), (views, bins), (7,)]
    support = torch.ones(1, pixels**2)
    index = torch.zeros(views, pixels**2, dtype=torch.int32)
    others = [torch.zeros(*shape) for shape in rest]
    return [tables, weights, biases, *moments, grid, support, index, *others]


def _dynamic(part: Any) -> Any:
    """Every dimension of a tensor or of the tensors of a list left open, those that never vary fixed: of
    `numbers`, the only vector, its length."""
    if isinstance(part, list):
        return [_dynamic(item) for item in part]
    auto, static = torch.export.Dim.AUTO, torch.export.Dim.STATIC
    fixed = part.dim() == 1
    return {i: static if fixed or size in (1, 2, 3) else auto for i, size in enumerate(part.shape)}


def _rename(value: Any, tensor: Tensor) -> None:
    """Write our names over the exporter's symbols."""
    for dimension, name in zip(value.type.tensor_type.shape.dim, tensor.shape, strict=True):
        dimension.Clear()
        if isinstance(name, int):
            dimension.dim_value = name
        else:
            dimension.dim_param = name


if __name__ == "__main__":
    step, about = export_step()
    write_entry(about, step, FOLDER)
