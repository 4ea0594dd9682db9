"""The page api.html of the site, from the docstrings of everything in `tagid.__all__` and of the types it takes and gives.

MkDocs calls it when it builds the site (`hooks` in mkdocs.yml); `python docs/make_api.py` prints the page.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import tagid
import tagid.errors

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

INTRODUCTION = """# Python API

[Examples](examples.md) shows whole programs. A real radar has a URL such as `udp://192.168.1.100` ([the radar](radar.md)). Settings that are not given here come from the
configuration, as for the commands.

`import tagid` provides the names of the first sections; each is loaded when it is first used, so the import itself is cheap. The
sections after them, one per module, hold the types of their arguments, results and fields: `from tagid.metadata import RadarInfo`.
Anything else may change between versions without notice.

Lengths are metres, angles radians, times seconds and frequencies hertz unless a name says otherwise. The object's plane is
z = 0 and the rotation axis is the origin ([architecture](architecture.md)).

"""
GROUPS = {
    "The whole job": ("Workplace", "Answer", "Config", "TagidError"),
    "Captures": (
        "Capture", "ObjectInfo", "read_any", "export", "load_capture", "LoadSettings", "LoadDefault", "prepare", "PreparedCapture",
    ),
    "Identification": ("identify", "Identification", "Cause", "Layout", "builtin_layouts", "Registry"),
    "Imaging": (
        "reconstruct", "Reconstruction", "ImagingSettings", "TagPriors", "AtsSettings", "ImageGrid", "ForwardOperator",
        "draw_image",
    ),
    "Recording": (
        "open_radar", "P440", "RadarConfig", "open_motion", "Motion", "RecordingPlan", "record", "Watch", "ScanStream",
    ),
    "Simulation": ("SceneSpec", "scene_from_name", "Scene", "Acquisition", "simulate_capture"),
    "Version": ("__version__",),
}  # fmt: skip
"""Order of the page; public names in none of these groups come after them."""
OPAQUE = {"BodyReading", "Explanation", "Session"}
"""Public types whose attributes are not public."""
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):$")
_TITLES = {"Args": "Arguments"}
_ENTRY = re.compile(r"^(?P<names>[*\w]+(?:, [*\w]+)*): (?P<text>.*)$")


def render() -> str:
    """The whole page."""
    listed = [name for names in GROUPS.values() for name in names]
    groups = {title: [n for n in names if n in tagid.__all__] for title, names in GROUPS.items()}
    groups["Other"] = [name for name in tagid.__all__ if name not in listed]
    parts = [INTRODUCTION]
    for title, names in groups.items():
        if names:
            parts.append(f"## {title}\n")
            parts += [entry(name, getattr(tagid, name)) for name in names]
    for module, types in types_by_module().items():
        parts.append(f"## {module}\n")
        parts += [entry(item.__name__, item) for item in types]
    return "\n".join(parts).rstrip("\n") + "\n"


@cache
def types_by_module() -> dict[str, list[type]]:
    """Types that the public names take, give and hold, and those of these types in turn, by module; all errors too."""
    public = [getattr(tagid, name) for name in tagid.__all__ if name != "__version__"]
    known = dict.fromkeys([*public, *(error for error in vars(tagid.errors).values() if inspect.isclass(error))])
    queue = list(known)
    while queue:
        thing = queue.pop()
        if thing.__name__ not in OPAQUE:
            annotations = annotations_of(thing).values()
            new = {kind for annotation in annotations for kind in own_classes(annotation)} - known.keys()
            known |= dict.fromkeys(new)
            queue += new
    types: dict[str, list[type]] = {}
    for item in sorted(known.keys() - set(public), key=lambda item: (item.__module__, item.__name__)):
        types.setdefault(item.__module__, []).append(item)
    return types


def annotations_of(thing: Any) -> dict[str, Any]:
    """Annotations that a user of a public function or class meets: arguments, results and fields."""
    if not inspect.isclass(thing):
        return resolved(thing)
    results = {}
    if "__init__" in vars(thing) or dataclasses.is_dataclass(thing):
        results = {f"(): {name}": item for name, item in resolved(thing.__init__).items()}
    results |= {f".{name}": item for name, item in resolved(thing).items() if not name.startswith("_")}
    for name, value in vars(thing).items():
        if not name.startswith("_") or name == "__call__":
            call = getattr(value, "fget", None) or getattr(value, "func", None) or getattr(value, "__func__", value)
            if inspect.isfunction(call):
                results |= {f".{name}: {argument}": item for argument, item in resolved(call).items()}
    return results


def resolved(thing: Any) -> dict[str, Any]:
    """Annotations of a function, or of the fields of a class, with all names resolved."""
    return get_type_hints(thing, names_in(thing.__module__))


@cache
def names_in(module: str) -> dict[str, Any]:
    """The names of a module, with those that it imports only for annotations."""
    result = dict(vars(sys.modules[module]))
    for block in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test):
            exec(compile(ast.Module(block.body, []), module, "exec"), result)
    return result


def own_classes(annotation: Any) -> Iterator[type]:
    """The classes of this package in an annotation, inside of unions, containers and callables too."""
    if isinstance(annotation, type) and annotation.__module__.split(".")[0] == "tagid":
        yield annotation
    for part in annotation if isinstance(annotation, list) else get_args(annotation):
        yield from own_classes(part)


def entry(name: str, thing: Any) -> str:
    """Heading, signature and docstring of a public name; of a class also its public members."""
    head = f"### {name}\n"
    if isinstance(thing, str):
        return f"{head}\nVersion of the package, a string.\n"
    if name in OPAQUE:
        summary = prose(thing).partition("\n")[0]
        return f"{head}\n```python\n{name}(...)\n```\n\n{summary} Its attributes are not part of the interface.\n"
    body = f"{head}\n```python\n{signature(name, thing)}\n```\n\n{prose(thing)}"
    if inspect.isclass(thing):
        body += "".join(member(name, key, vars(thing)[key]) for key in members(thing))
    return body


def members(kind: type) -> list[str]:
    """Names of what a class documents itself: methods and properties, in the order of the source."""
    wanted = (property, cached_property, classmethod, staticmethod)
    return [
        key
        for key, value in vars(kind).items()
        if (inspect.isfunction(value) or isinstance(value, wanted))
        and (not key.startswith("_") or key == "__call__")
        and inspect.getdoc(value)
    ]


def member(owner: str, name: str, value: Any) -> str:
    """One method or property."""
    if isinstance(value, property | cached_property):
        title, code = f"{owner}.{name}", ""
    else:
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        title = f"{owner}()" if name == "__call__" else f"{owner}.{name}()"
        shown = "operator" if name == "__call__" else name
        code = f"```python\n{signature(shown, function, bound=not isinstance(value, staticmethod))}\n```\n\n"
    return f"\n#### {title}\n\n{code}{prose(value)}"


def signature(name: str, thing: Any, bound: bool = False) -> str:
    """The call with annotations as written in the source, one argument per line if it is long.

    Of an enumeration the members, of a protocol only that it is one.
    """
    if inspect.isclass(thing) and issubclass(thing, Enum):
        return f"{name}({thing.__mro__[1].__name__})\n" + "\n".join(f"    {item.name} = {item.value!r}" for item in thing)
    if inspect.isclass(thing) and getattr(thing, "_is_protocol", False):
        return f"{name}(Protocol)"
    result = inspect.signature(thing)
    words: list[str] = []
    for parameter in list(result.parameters.values())[1 if bound else 0 :]:
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in words:
            words.append("*")
        words.append(argument(parameter))
    answer = result.return_annotation
    tail = "" if inspect.isclass(thing) or answer is inspect.Signature.empty else f" -> {annotation(answer)}"
    line = f"{name}({', '.join(words)}){tail}"
    if len(line) <= 100:
        return line
    inner = "".join(f"    {word},\n" for word in words)
    return f"{name}(\n{inner}){tail}"


def argument(parameter: inspect.Parameter) -> str:
    """`name: type = default`; a default that is made at each call, or that names the version, is "..."."""
    kind, default = parameter.annotation, parameter.default
    text = parameter.name if kind is parameter.empty else f"{parameter.name}: {annotation(kind)}"
    if default is parameter.empty:
        return text
    default = float(default) if isinstance(default, float) else default  # numpy's too
    plain = isinstance(default, str | int | float | bool | tuple | None) and default != tagid.__version__
    if isinstance(default, Enum):
        return f"{text} = {type(default).__name__}.{default.name}"
    return f"{text} = {repr(default) if plain else '...'}"


def annotation(kind: Any) -> str:
    """A type as the source spells it; that of a named tuple's field is a reference."""
    kind = getattr(kind, "__forward_arg__", kind)
    return (kind if isinstance(kind, str) else getattr(kind, "__name__", str(kind))).strip("'\"")


def prose(thing: Any) -> str:
    """The docstring as Markdown: sections become lists, indented text and examples are code, the rest is plain."""
    lines: list[str] = []
    section = example = False
    for line in (inspect.getdoc(thing) or "").splitlines():
        if example or line.startswith(">>> "):
            example, started = bool(line), example
            lines += [*([] if started else ["```python"]), *([line] if line else ["```", ""])]
        elif match := _SECTION.match(line):
            section = True
            lines += [f"**{_TITLES.get(match[1], match[1])}**", ""]
        elif section and line.startswith("        "):
            lines.append(f"  {escaped(line.strip())}")
        elif section and line.startswith("    "):
            matched = _ENTRY.match(line.strip())
            names = ", ".join(f"`{item}`" for item in matched["names"].split(", ")) if matched else ""
            lines.append(f"- {names}: {escaped(matched['text'])}" if matched else f"- {escaped(line.strip())}")
        elif line.startswith("    "):
            lines.append(line)
        else:
            section = section and not line
            lines.append(escaped(line))
    if example:
        lines.append("```")
    return "\n".join(lines).rstrip("\n") + "\n"


def escaped(text: str) -> str:
    """Text whose stars, underscores and angle brackets Markdown leaves alone; `code` stays as it is."""
    pieces = re.split(r"(`[^`]*`)", text)
    for i in range(0, len(pieces), 2):
        pieces[i] = re.sub(r"([*_\\])", r"\\\1", pieces[i]).replace("<", "&lt;").replace(">", "&gt;")
    return "".join(pieces)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the page to the site (https://www.mkdocs.org/dev-guide/plugins/#on_files)."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "api.md", content=render()))


if __name__ == "__main__":
    print(render())
