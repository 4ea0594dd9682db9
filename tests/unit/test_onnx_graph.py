"""The network on numpy: the same numbers as on onnxruntime, and a clear refusal of anything else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from tagid.errors import ModelError
from tagid.models_store import entry_of, open_model, open_small_model, write_entry
from tagid.onnx_graph import Graph, Port
from tagid.tags.network.detector import MODEL


def test_the_detector_gives_what_it_gives_on_onnxruntime() -> None:
    planes = np.random.default_rng(5).standard_normal((1, 5, 96, 96)).astype(np.float32)
    there, here = open_model(MODEL), open_small_model(MODEL)
    assert here.entry == there.entry
    assert dict(here.metadata) == dict(there.metadata)
    wanted, found = there.run({"planes": planes}), here.run({"planes": planes})
    for name, values in wanted.items():
        assert found[name].shape == values.shape
        assert np.abs(found[name] - values).max() < 1e-5 * np.abs(values).max(), name


def graph_of(
    nodes: list[onnx.NodeProto], constants: dict[str, np.ndarray], shape: list[int | str]
) -> onnx.ModelProto:
    """A model of one input x and one output y."""
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "test", [x], [y], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])


def test_operators_follow_their_definition() -> None:
    """Against onnx's own reference, for what the detector does not use: odd strides, pads and sizes."""
    from onnx.reference import ReferenceEvaluator

    rng = np.random.default_rng(2)
    constants = {
        "w": rng.standard_normal((3, 2, 3, 2)).astype(np.float32),
        "b": rng.standard_normal(3).astype(np.float32),
        "v": rng.standard_normal((3, 4, 2, 3)).astype(np.float32),
        "c": rng.standard_normal(4).astype(np.float32),
        "axes": np.array([-1]),
        "shape": np.array([0, -1]),
        "m": rng.standard_normal((5, 4 * 8)).astype(np.float32),
        "d": rng.standard_normal(5).astype(np.float32),
    }
    nodes = [
        helper.make_node("Conv", ["x", "w", "b"], ["1"], strides=[2, 1], pads=[1, 0, 2, 1]),
        helper.make_node("ConvTranspose", ["1", "v", "c"], ["2"], strides=[2, 3]),
        helper.make_node("ReduceMean", ["2", "axes"], ["3"], keepdims=0),
        helper.make_node("Reshape", ["3", "shape"], ["4"]),
        helper.make_node("Gemm", ["4", "m", "d"], ["y"], transB=1, alpha=0.5, beta=2.0),
    ]
    x = rng.standard_normal((2, 2, 7, 9)).astype(np.float32)
    model = graph_of(nodes, constants, ["n", 2, 7, 9])
    (wanted,) = ReferenceEvaluator(model).run(None, {"x": x})
    graph = Graph(model.SerializeToString())
    assert graph.inputs == (Port("x", "float32", ("n", 2, 7, 9)),)
    (found,) = graph.run(["y"], {"x": x})
    assert np.allclose(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("node", "words"),
    [
        (helper.make_node("Sigmoid", ["x"], ["y"]), "operators Sigmoid are not supported"),
        (helper.make_node("Conv", ["x", "w", "b"], ["y"], group=2), "grouped or dilated"),
        (helper.make_node("ConvTranspose", ["x", "w", "b"], ["y"], strides=[1, 1]), "overlapping"),
    ],
)
def test_what_numpy_does_not_run_is_refused(node: onnx.NodeProto, words: str) -> None:
    constants = {"w": np.zeros((2, 2, 2, 2), np.float32), "b": np.zeros(2, np.float32)}
    content = graph_of([node], constants, [1, 2, 4, 4]).SerializeToString()
    with pytest.raises(ModelError, match=words):
        Graph(content).run(["y"], {"x": np.zeros((1, 2, 4, 4), np.float32)})


def test_a_model_of_other_shapes_or_cut_off_is_refused(tmp_path: Path) -> None:
    from tagid.models_store import Tensor

    content = graph_of([helper.make_node("Relu", ["x"], ["y"])], {}, [1, 2]).SerializeToString()
    ports = {"x": Tensor("float32", (1, 3))}, {"y": Tensor("float32", ())}
    write_entry(entry_of("relu", content, *ports, {}), content, tmp_path)
    with pytest.raises(ModelError, match=r"x is .*\(1, 2\).*manifest says .*\(1, 3\)"):
        open_small_model("relu", tmp_path)
    write_entry(entry_of("relu", content[:-3], *ports, {}), content[:-3], tmp_path)
    with pytest.raises(ModelError):
        open_small_model("relu", tmp_path)
