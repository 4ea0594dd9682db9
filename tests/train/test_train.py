"""The detector's workshop in small: a seed's data, training that goes on after a kill, an export."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra 'ats'")

from tagid.errors import ModelError, StorageError, UsageError  # noqa: E402
from tagid.models_store import manifest, open_model  # noqa: E402
from train import dataset  # noqa: E402
from train.dataset import DatasetPlan, ImageOf, Samples, Size, build, load  # noqa: E402
from train.detector import CELL_M, CELLS, FOLDER, MODEL, Contract, Detection, Detector  # noqa: E402
from train.distributions import Distribution, ObjectDistribution  # noqa: E402
from train.evaluate import Figures, score  # noqa: E402
from train.export import check_better, export  # noqa: E402
from train.fit import FitSettings, fit  # noqa: E402
from train.network import DetectorNetwork  # noqa: E402
from train.scenes import draw_scene  # noqa: E402
from train.targets import batch_arrays, cell_targets, symmetry  # noqa: E402


def samples_of(count: int, distribution: Distribution) -> Samples:
    return Samples.joined(dataset.sample(ImageOf(seed, "bp"), distribution) for seed in range(count))


@pytest.fixture(scope="module")
def few() -> Samples:
    """Of simple objects: a metal body off the axis outshines its tag in the image."""
    return samples_of(10, replace(Distribution(), object=ObjectDistribution(physical=0.0)))


def test_a_seed_is_a_scene() -> None:
    first, again, other = draw_scene(5), draw_scene(5), draw_scene(6)
    assert np.array_equal(first.capture.samples, again.capture.samples)
    assert not np.array_equal(first.reflectors_m, other.reflectors_m)


def test_images_are_bright_where_the_truth_says(few: Samples) -> None:
    hits = total = 0
    for i in range(len(few)):
        if few.scene_snr_db[i] < 8:
            continue
        magnitude = np.abs(few.relative[i, 0].astype(float) + 1j * few.relative[i, 1].astype(float))
        for x, y in few.reflectors[i][np.isfinite(few.reflectors[i][:, 0])]:
            column, row = (round((v / 0.5 + 0.5) * 96 - 0.5) for v in (x, y))
            hits += magnitude[row - 2 : row + 3, column - 2 : column + 3].max() > 0.3
            total += 1
    assert total > 8
    assert hits / total > 0.8


def test_bodies_stand_in_the_middle_of_their_tags() -> None:
    """All reflectors of a physical object lie equally far, to 2 mm each, from the middle of its body."""
    physical = replace(Distribution(), object=ObjectDistribution(physical=1.0))
    drawn = (draw_scene(seed, physical) for seed in range(20))
    tagged = (scene for scene in drawn if scene.ghosts and len(scene.reflectors_m) > 1)
    for _ in range(3):
        scene = next(tagged)
        away = np.linalg.norm(scene.reflectors_m - scene.ghosts[0].centre_m, axis=1)
        assert np.ptp(away) <= 0.004
        assert away.min() > scene.ghosts[0].radius_m - 0.002


@pytest.mark.parametrize("which", range(8))
def test_symmetries_move_picture_and_points_together(which: int) -> None:
    picture = np.zeros((96, 96))
    picture[70, 20] = 1
    point = (np.array([[20.5, 70.5]]) / 96 - 0.5) * 0.5
    moved, at = symmetry(picture, point, which)
    row, column = np.unravel_index(np.argmax(moved), moved.shape)
    assert at[0] == pytest.approx([((column + 0.5) / 96 - 0.5) * 0.5, ((row + 0.5) / 96 - 0.5) * 0.5])


def test_targets_lead_back_to_the_reflector() -> None:
    truth = np.array([[0.0731, -0.1012], [np.nan, np.nan]])
    heat, ghost, near, offset = cell_targets(truth, np.array([[0.0, 0.0, 0.05]]))
    row, column = np.unravel_index(np.argmax(heat), heat.shape)
    assert heat[row, column] == 1
    x = (column + offset[0, row, column] - CELLS / 2 + 0.5) * CELL_M
    y = (row + offset[1, row, column] - CELLS / 2 + 0.5) * CELL_M
    assert (x, y) == pytest.approx(tuple(truth[0]), abs=1e-6)
    assert ghost.sum() > 20
    assert not (ghost * near).any()


def test_a_shard_is_made_once_and_a_lost_one_again(tmp_path: Path) -> None:
    plan = DatasetPlan("validation", 2, ats_every=0)
    build(tmp_path, plan)
    first = load(tmp_path, plan)
    (shard,) = (tmp_path / "validation").glob("*.npz")
    stamp = shard.stat().st_mtime_ns
    build(tmp_path, plan)
    assert shard.stat().st_mtime_ns == stamp
    shard.unlink()
    with pytest.raises(StorageError, match="0000"):
        load(tmp_path, plan)
    build(tmp_path, plan)
    assert np.array_equal(load(tmp_path, plan).relative, first.relative)
    with pytest.raises(UsageError, match="another kind"):
        build(tmp_path, DatasetPlan("validation", 2, ats_every=2))


def test_training_learns_and_goes_on_where_it_was_killed(few: Samples, tmp_path: Path) -> None:
    settings = FitSettings(epochs=2, batch=5, threads=1)
    whole = fit(few, few, tmp_path / "whole.pt", settings)

    def kill(step: int, steps: int) -> None:
        if step == steps // 2 + 1:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        fit(few, few, tmp_path / "cut.pt", settings, progress=kill)
    losses: list[float] = []
    resumed = fit(
        few, few, tmp_path / "cut.pt", settings, report=lambda epoch, *both: losses.append(both[0]), jobs=2
    )
    assert len(losses) == 1
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(StorageError, match="another training"):
        fit(few, few, tmp_path / "cut.pt", FitSettings(epochs=4, batch=5, threads=1))


def test_an_exported_network_says_what_torch_says(few: Samples, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = DetectorNetwork().eval()
    contract = Contract(2.0, 0.1, 1.0, 0.0, 1.5, {"0.01": 0.7}, {"commit": "x", "seed": 0, "scenes": 1})
    path = export(network, contract, {}, tmp_path)
    assert path.stat().st_size < 1_000_000
    detector = Detector(open_model(MODEL, folder=tmp_path))
    assert detector.contract == contract
    planes = batch_arrays(few, np.arange(1))[0]
    with torch.no_grad():
        cells, present = network(torch.from_numpy(planes))
    out = open_model(MODEL, folder=tmp_path).run({"planes": planes})
    np.testing.assert_allclose(out["cells"], cells.numpy(), atol=2e-4)
    np.testing.assert_allclose(out["present"], present.numpy(), atol=2e-4)


def test_each_reflector_is_hit_once() -> None:
    truth = np.full((dataset.MOST_REFLECTORS, 2), np.nan)
    truth[0], truth[1] = (0.05, 0.0), (-0.05, 0.0)
    results = [Detection(0.052, 0.0, 2e-3, p, 0.0, 1.0) for p in (0.9, 0.8)]
    outcome = score(results, truth)
    assert outcome.hits.tolist() == [True, False]
    assert outcome.missed == 1
    figures = Figures.of([outcome], 0.5)
    assert (figures.recall, figures.precision) == (0.5, 0.5)
    assert figures.rms_mm == pytest.approx(2.0)


def test_a_worse_network_does_not_replace_the_shipped_one() -> None:
    now = manifest(FOLDER)[MODEL].facts["figures"]["all"]
    as_good = Figures(now["images"], now["reflectors"], now["recall"], 1.0, 0.0, 2.0, now["presence"])
    check_better({"all": as_good})
    for change in ({"recall": 0.0}, {"false_images": 0.5}, {"images": 2}):
        worse = replace(as_good, **change)
        with pytest.raises(ModelError, match="not installed"):
            check_better({"all": worse})


def test_a_folder_remembers_the_size_of_its_dataset(tmp_path: Path) -> None:
    work = tmp_path / "new" / "work"
    with pytest.raises(StorageError, match="holds no dataset"):
        Size.of(work)
    Size(24, 0).remember(work)
    assert Size.of(work) == Size(24, 0)
