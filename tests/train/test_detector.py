"""The network's input and answers: what is scaled, what is turned, what a foreign file says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import ModelError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import preprocess
from tagid.imaging.types import Image
from tagid.models_store import model_bytes
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.scene import Scene
from train.detector import CELL_M, CELLS, FOLDER, MODEL, Contract, Detector, decode
from train.planes import GRID, NetworkInput

CONTRACT = Contract(1.0, 0.0, 1.0, 0.0, 1.0, {"0.1": 0.5, "0.01": 0.9}, {})


def seen_points(points: np.ndarray, snr_db: float = 20.0, scale: complex = 1.0) -> NetworkInput:
    return seen(Scene.of_points(points), 4, snr_db, scale)


def seen(scene: Scene, seed: int, snr_db: float, scale: complex = 1.0) -> NetworkInput:
    capture, _ = simulate_capture(scene, Acquisition(views=36, snr_db=snr_db), seed=seed)
    scans = preprocess(capture)
    values = (backproject(scans, GRID).values * scale).astype(np.complex64)
    return NetworkInput.of(Image(values, GRID), scans)


def test_planes_do_not_know_the_phase() -> None:
    points = np.array([[0.08, 0.0], [-0.05, 0.06]])
    plain = seen_points(points).planes()
    turned = seen_points(points, scale=1j).planes()
    np.testing.assert_allclose(turned, plain, atol=1e-5)
    assert plain[2].max() == pytest.approx(1)
    assert plain[0].flat[int(np.argmax(plain[2]))] == pytest.approx(1)
    assert seen_points(points, snr_db=5.0).planes()[3, 0, 0] < plain[3, 0, 0]


def test_another_grid_is_refused() -> None:
    capture, _ = simulate_capture(Scene.of_points(np.array([[0.08, 0.0]])), Acquisition(views=12))
    scans = preprocess(capture)
    with pytest.raises(UsageError, match="64 pixels"):
        NetworkInput.of(backproject(scans, ImageGrid(0.5, 64)), scans)


def test_cells_become_metres() -> None:
    cells = np.full((5, CELLS, CELLS), -9.0, dtype=np.float32)
    row, column = 30, 10
    cells[:, row, column] = 3.0, -3.0, 0.25, -0.5, np.log(0.2)
    cells[0, row, column + 1] = 2.0  # a neighbour on the same reflector
    (result, *rest) = decode(cells, seen_points(np.array([[0.08, 0.0]])), CONTRACT)
    assert result.x_m == pytest.approx((column + 0.25 + 0.5) * CELL_M - GRID.extent / 2)
    assert result.y_m == pytest.approx((row - 0.5 + 0.5) * CELL_M - GRID.extent / 2)
    assert result.sigma_m == pytest.approx(0.2 * CELL_M)
    assert result.probability == pytest.approx(1 / (1 + np.exp(-3)))
    assert all(np.hypot(d.x_m - result.x_m, d.y_m - result.y_m) >= 0.02 for d in rest)


def test_the_shipped_network_finds_reflectors_where_they_are() -> None:
    points = np.array([[0.1, 0.02], [-0.06, 0.07], [-0.03, -0.09]])
    answer = Detector.shipped().detect(seen_points(points))
    assert answer.present > 0.9
    assert len(answer.detections) == 3
    for point in points:
        gap = min(np.hypot(d.x_m - point[0], d.y_m - point[1]) for d in answer.detections)
        assert gap < 0.005


def test_noise_alone_holds_no_reflector() -> None:
    scene = Scene("empty", reference_amplitude=1.0)
    detector = Detector.shipped()
    false = sum(bool(detector.detect(seen(scene, seed, 5.0)).detections) for seed in range(20))
    assert false <= 2


@pytest.mark.parametrize(
    "change", [{"schema": 99}, {"grid": {"extent_m": 1.0, "pixels": 96}}, {"thresholds": {}}, {"slope": None}]
)
def test_another_contract_is_refused(change: dict[str, object]) -> None:
    text = json.dumps({**json.loads(CONTRACT.to_text()), **change})
    for wrong in (text, "", "{}", "[]", "null", '{"kind": 1}'):
        with pytest.raises(ModelError, match="contract"):
            Contract.from_text(wrong, "a model")


def test_contract_travels_with_the_file() -> None:
    detector = Detector.shipped()
    assert Contract.from_text(detector.contract.to_text(), "x") == detector.contract
    said = json.loads(detector.contract.to_text())
    assert said["normalisation"]["planes"] == ["real", "imaginary", "magnitude", "snr", "views"]
    said["normalisation"]["relative_to"] = "mean"
    with pytest.raises(ModelError, match=r"normalises by .*'mean'.* this program by .*brightest"):
        Contract.from_text(json.dumps(said), "a model")
    assert {"commit", "seed", "scenes"} <= set(detector.contract.training)
    assert detector.contract.threshold(0.01) >= detector.contract.threshold(0.1)


def test_a_damaged_model_is_refused_with_both_hashes(tmp_path: Path) -> None:
    for name in ("manifest.json", f"{MODEL}.onnx"):
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    content = bytearray((tmp_path / f"{MODEL}.onnx").read_bytes())
    content[1000] ^= 1
    (tmp_path / f"{MODEL}.onnx").write_bytes(content)
    with pytest.raises(ModelError, match=r"sha256 [0-9a-f]{64}.*manifest says [0-9a-f]{64}"):
        model_bytes(MODEL, tmp_path)
