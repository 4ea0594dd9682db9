"""The public index: cheap to import, complete, and what it lists can be used as documented."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

import tagid


def test_every_public_name_is_there() -> None:
    for name in tagid.__all__:
        assert getattr(tagid, name) is not None
        assert name in dir(tagid)


def test_importing_tagid_imports_nothing_else() -> None:
    code = (
        "import sys, tagid; print(sorted(m for m in sys.modules if m.split('.')[0] in ('numpy', 'h5py') or "
    )
    code += "m.startswith('tagid.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    try:
        tagid.nothing  # noqa: B018
    except AttributeError as error:
        assert "nothing" in str(error)
    else:
        raise AssertionError("no error")


def test_a_notebook_goes_from_a_scene_to_a_name() -> None:
    capture, truth = tagid.simulate_capture(
        tagid.scene_from_name("helmet-120", 3), tagid.Acquisition(views=36, snr_db=20), seed=3
    )
    prepared = tagid.PreparedCapture(tagid.prepare(capture), tagid.ImagingSettings(method="bp", pixels=48))
    image = tagid.reconstruct(prepared).image
    assert image.values.shape == (48, 48)
    answer = tagid.identify(prepared, tuple(tagid.builtin_layouts().values()))
    assert (answer.status, answer.reading.layout) == ("identified", "helmet-120")
    assert truth.positions_m.shape == (3, 2)


def test_an_operator_is_called_like_a_matrix() -> None:
    """<A x, y> = <x, A^H y>, with the shape that the operator states."""
    capture, _ = tagid.simulate_capture(
        tagid.scene_from_name("helmet-120", 3), tagid.Acquisition(views=12), seed=3
    )
    prepared = tagid.PreparedCapture(tagid.prepare(capture))
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    A = tagid.ForwardOperator(scans, tagid.ImageGrid(0.3, 16))
    rng = np.random.default_rng(0)
    x = (rng.standard_normal(256) + 1j * rng.standard_normal(256)).astype(np.complex64)
    y = (rng.standard_normal(scans.samples.shape) + 1j).astype(np.complex64)
    assert A.shape == (scans.samples.size, 256)
    np.testing.assert_allclose(np.vdot(A(x), y), np.vdot(x, A.adjoint(y)), rtol=1e-4)
