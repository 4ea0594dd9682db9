"""The public index: cheap to import, complete, and what it lists can be used as documented."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

import numpy as np

import tagid


def test_every_public_name_is_there() -> None:
    for name in tagid.__all__:
        assert getattr(tagid, name) is not None
        assert name in dir(tagid)


def api_page_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "make_api", Path(__file__).parents[2] / "docs" / "make_api.py"
    )
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def names_in(module: ModuleType) -> dict[str, Any]:
    """Everything that a module imports only for annotations, under the names that it uses."""
    found: dict[str, Any] = {}
    for block in ast.parse(inspect.getsource(module)).body:
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test):
            exec(compile(ast.Module(block.body, []), module.__name__, "exec"), found)
    return found


def annotated(thing: Any) -> dict[str, Any]:
    """Annotations of a function, or of the fields of a class, with all names resolved."""
    module = sys.modules[thing.__module__]
    return get_type_hints(thing, {**vars(module), **names_in(module)})


def own_classes(annotation: Any) -> Iterator[type]:
    """The classes of this package in an annotation, inside of unions, containers and callables too."""
    if isinstance(annotation, type) and annotation.__module__.split(".")[0] == "tagid":
        yield annotation
    parts = annotation if isinstance(annotation, list) else get_args(annotation)
    for part in parts:
        yield from own_classes(part)


def public_annotations(thing: Any) -> dict[str, Any]:
    """Annotations that a user of a public function or class meets: arguments, results and fields."""
    if not inspect.isclass(thing):
        return annotated(thing)
    found = {}
    if "__init__" in vars(thing) or dataclasses.is_dataclass(thing):
        found = {f"(): {name}": a for name, a in annotated(thing.__init__).items()}
    fields = annotated(thing)
    found |= {f".{name}": a for name, a in fields.items() if not name.startswith("_")}
    for name, member in vars(thing).items():
        if name.startswith("_") and name != "__call__":
            continue
        call = (
            getattr(member, "fget", None)
            or getattr(member, "func", None)
            or getattr(member, "__func__", member)
        )
        if inspect.isfunction(call):
            found |= {f".{name}: {argument}": a for argument, a in annotated(call).items()}
    return found


def test_every_type_that_a_public_name_takes_or_gives_is_public() -> None:
    """An opaque type is public itself, but what it consists of is not."""
    opaque = api_page_script().OPAQUE
    public = {name: getattr(tagid, name) for name in tagid.__all__ if name != "__version__"}
    hidden = [
        f"{name}{where} is a {found.__module__}.{found.__qualname__}"
        for name, thing in public.items()
        if name not in opaque
        for where, annotation in public_annotations(thing).items()
        for found in own_classes(annotation)
        # The page names the module of the errors.
        if public.get(found.__name__) is not found and found.__module__ != "tagid.errors"
    ]
    assert hidden == []


def test_types_inside_of_containers_are_found() -> None:
    found = set(own_classes(dict[str, tuple[tagid.Capture, ...] | None] | Callable[[tagid.Layout], int]))
    assert found == {tagid.Capture, tagid.Layout}
    assert list(own_classes(np.ndarray | int)) == []


def test_importing_tagid_imports_nothing_else() -> None:
    """Not even `typing`, the most expensive one; -S because the site of an editable install loads it."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(tagid.__file__).parents[1])!r}); import tagid; "
        "print(sorted(m for m in sys.modules if m.split('.')[0] in ('numpy', 'h5py', 'typing') or "
        "m.startswith('tagid.')))"
    )
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
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
