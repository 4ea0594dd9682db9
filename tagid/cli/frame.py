"""Functions shared by all commands: common options, error handling, output.

The module of a command contains only its options and one call into the library.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import io
import json
import logging
import math
import os
import shlex
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.models import OptionInfo

from tagid import interrupts
from tagid.cli.wording import result_in_options
from tagid.errors import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    CaptureInterrupted,
    StorageError,
    TagidError,
    UsageError,
    visible,
)
from tagid.result import Result, render

if TYPE_CHECKING:
    from rich.text import Text

    from tagid.result import Drawn


class Output(StrEnum):
    human = "human"
    json = "json"


@dataclass(frozen=True)
class Terminal:
    """Output format and progress display of this run."""

    output: StrEnum = Output.human
    quiet: bool = False
    verbose: int = 0

    @contextmanager
    def progress(self, what: str, total: float | None = None) -> Iterator[Callable[[float, str], None]]:
        """A progress line on stderr; call the yielded function with (done, remark)."""
        if self.quiet:
            yield lambda done, remark: None
            return
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[remark]}"),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=False) as bars:
            task = bars.add_task(f"{what:<12}", total=total, remark="")

            def advance(done: float, remark: str) -> None:
                bars.update(task, completed=done, remark=escape(visible(remark)))

            yield advance
            if total is not None:
                bars.update(task, completed=total)

    def show(self, human: Drawn) -> None:
        """Print a part of the answer before the command ends; nothing where that is JSON.

        Raises OSError.
        """
        if self.output == Output.human:
            render(Result("", human=human), self.output, self.quiet)


@dataclass(frozen=True)
class Command:
    """A command as a module declares it.

    Attributes:
        name: with its group, e.g. "radar find".
        run: takes the options, runs the command and raises typer.Exit.
        help: of the function; of a group the command that runs without another.
        is_group: whether it runs when the group of its name is called without a command.
        negative_arguments: whether -1 is an argument; the command must then refuse unknown options itself.
    """

    name: str
    run: Callable[..., None]
    help: str
    is_group: bool = False
    negative_arguments: bool = False

    def add_to(self, app: typer.Typer) -> None:
        """Register it with an app, which is its group's if it has one."""
        if self.is_group:
            app.callback(invoke_without_command=True, help=self.help)(self.run)
        else:
            first = self.help.partition("\n\n")[0]
            app.command(
                self.name.rpartition(" ")[2],
                help=self.help,
                short_help=first,
                context_settings={"ignore_unknown_options": self.negative_arguments},
            )(self.run)


_COMMANDS: dict[str, list[Command]] = {}
"""Commands by the module that declares them, in its order."""


def commands_of(module: str) -> list[Command]:
    """The commands that a module declares; it is imported if necessary."""
    importlib.import_module(module)
    return _COMMANDS.get(module, [])


def command(
    name: str, formats: type[StrEnum] = Output, negative_arguments: bool = False, is_group: bool = False
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Declare a function `(terminal, ...) -> Result` as a command with the common options added.

    A parameter whose type is a dataclass stands for options declared as its fields. An option that names
    itself no other has the name of its parameter.
    `formats` are the choices of --output: "human", "json" and, if the result has one, "csv". For
    `negative_arguments` and `is_group` see `Command`.
    """

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        run = _with_common_options(name, function, formats, is_group)
        declared = Command(name, run, _help_of(function), is_group, negative_arguments)
        _COMMANDS.setdefault(function.__module__, []).append(declared)
        return function

    return decorate


def _help_of(function: Callable[..., Any]) -> str:
    """Help of a command: its docstring with its examples unwrapped and its first sentence on one line."""
    first, *rest = inspect.cleandoc(function.__doc__ or "").split("\n\n")
    # A line of \\b keeps the lines of the paragraph that follows it.
    return "\n\n".join([first.replace("\n", " "), *rest]).replace("\n\nExample:", "\n\n\b\nExample:")


def _with_common_options(
    name: str, function: Callable[..., Result], formats: type[StrEnum], is_group: bool
) -> Callable[..., None]:
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = [p for p in inspect.signature(function).parameters.values() if p.name != "terminal"]
    unwrapped = [option for p in parameters for option in _options_of(p, hints[p.name])]
    values = {p.name: hints[p.name] for p in parameters if is_dataclass(hints[p.name])}
    declared = {parameter.name: _declared(parameter) for parameter in unwrapped}
    added = {
        "output": (formats("human"), formats, typer.Option("--output", help="Text, or one JSON document.")),
        "quiet": (False, bool, typer.Option("--quiet", "-q", help="Show no progress bar and no remarks.")),
        "verbose": (
            0, int, typer.Option("--verbose", "-v", count=True, help="Log more; -vv: debug messages.")
        ),
    }  # fmt: skip
    common = [
        inspect.Parameter(
            key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
        )
        for key, (default, kind, option) in added.items()
    ]
    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
    taken = [*([context] if is_group else ()), *unwrapped, *common]

    @functools.wraps(function)
    def run(context: typer.Context | None = None, **options: Any) -> None:
        if context is not None and context.invoked_subcommand is not None:
            return
        terminal = Terminal(options.pop("output"), options.pop("quiet"), options.pop("verbose"))

        def work() -> Result:
            given = {key: _accepted(key, declared[key], value) for key, value in options.items()}
            for key, kind in values.items():
                given[key] = kind(**{item.name: given.pop(item.name) for item in fields(kind)})
            return function(terminal, **given)

        result = execute(name, terminal, work)
        raise typer.Exit(result.exit_code)

    run.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in taken}
    return run


def _options_of(parameter: inspect.Parameter, kind: Any) -> list[inspect.Parameter]:
    """The options that a parameter stands for: itself, or the fields of a dataclass."""
    if not is_dataclass(kind):
        return [parameter.replace(annotation=kind)]
    hints = typing.get_type_hints(kind, include_extras=True)
    return [
        inspect.Parameter(
            item.name,
            parameter.kind,
            default=parameter.empty if item.default is MISSING else item.default,
            annotation=hints[item.name],
        )
        for item in fields(kind)
    ]


def _declared(parameter: inspect.Parameter) -> OptionInfo | None:
    """The declaration of an option; None of an argument."""
    infos = getattr(parameter.annotation, "__metadata__", ())
    return next((info for info in infos if isinstance(info, OptionInfo)), None)


def _accepted(name: str, option: OptionInfo | None, value: Any) -> Any:
    """The value of an option as a command gets it: a name of a file that is a link means its target.

    Raises UsageError: not a number where the option is declared with bounds, which its comparisons pass.
    """
    if option is None or value is None:
        return value
    if isinstance(value, list):
        return [_accepted(name, option, item) for item in value]
    bounds = (option.min, option.max)
    if isinstance(value, float) and bounds != (None, None):
        if math.isnan(value):
            raise UsageError(f"--{name.replace('_', '-')} is not a number", "Give a number.")
        # Of an option with a unit, the bounds are not known to typer.
        low = -math.inf if option.min is None else option.min
        high = math.inf if option.max is None else option.max
        if not low <= value <= high:
            raise UsageError(f"--{name.replace('_', '-')} is {value:g}", f"Give {low:g} to {high:g}.")
    if isinstance(value, Path) and name != "link":
        from tagid.files import resolved

        return resolved(value)
    return value


def execute(name: str, terminal: Terminal, work: Callable[[], Result]) -> Result:
    """Run the work, turn its outcome or error into a Result, write it, and return it."""
    _set_up_logging(terminal)
    try:
        result = work()
    except TagidError as error:
        result = Result.from_error(name, error)
    except typer.Exit:
        raise
    except KeyboardInterrupt as stop:
        result = Result.from_error(name, interrupts.stopped_by_user(stop))
    except BrokenPipeError:
        return Result(name, exit_code=EXIT_FAILED)
    except Exception as error:
        logging.getLogger("tagid").debug("unexpected error", exc_info=True)
        # A library may raise any exception if its import is interrupted.
        stopped = interrupts.delivered()
        fault = CaptureInterrupted("stopped by the user") if stopped else TagidError.unexpected(error)
        result = Result.from_error(name, fault)
    if result.exit_code == EXIT_INTERRUPTED:
        logging.getLogger("tagid").info("interrupted")
    return _write(result, terminal.output.value, terminal.quiet)


def _write(result: Result, output: str, quiet: bool = False) -> Result:
    """Render a result; returns it, or one that reports that its output could not be written."""
    try:
        render(result_in_options(result), output, quiet)
    except BrokenPipeError:  # its reader has read enough
        _drop_if_broken(sys.stdout)
    except OSError as error:
        _drop_if_broken(sys.stdout)
        sys.stderr.write(f"error: the output cannot be written: {error.strerror or error}\n")
        sys.stderr.flush()
        return replace(result, exit_code=result.exit_code or EXIT_FAILED)
    return result


def _drop_if_broken(stream: typing.TextIO) -> None:
    """Redirect a stream that cannot be written to the null device.

    Flushing its buffer would fail again when the interpreter exits.
    """
    try:
        stream.flush()
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)


class _Remarks(io.TextIOWrapper):
    """Standard error that may fail: remarks and progress are then dropped, and the work goes on."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            super().flush()


def _secure_streams() -> None:
    """Make the standard streams safe to use, however the process was started.

    One that is closed is connected to the null device: the next file opened would otherwise get its number,
    and with it whatever is written there.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)
            stream = os.fdopen(descriptor, "r" if number == 0 else "w", encoding="utf-8")
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)
    if isinstance(sys.stderr, io.TextIOWrapper):
        stderr = sys.stderr
        sys.stderr = _Remarks(stderr.buffer, stderr.encoding, stderr.errors, line_buffering=True)


def run_program(app: typer.Typer) -> typing.NoReturn:
    """Run the command line of a program and end the process with its exit code (`serve`)."""
    _secure_streams()
    try:
        with interrupts.handled(to_the_end=True):
            code = serve(app)
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    sys.exit(code)


def serve(app: typer.Typer) -> int:
    """Run the command line of a program; report an invalid one in the requested format.

    Returns the exit code.
    """
    name = app.info.name or "tagid"
    # A terminal that knows only ASCII or Latin-1 must not cost the answer: what it lacks is written as \\xfc.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.encoding.lower() not in ("utf-8", "utf8"):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with interrupts.handled():
            code = app(standalone_mode=False)
    except typer.TyperException as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # a program or group without a command
            typer.echo(error.format_message())
            return 0
        as_json = any(word == "json" or word == "--output=json" for word in sys.argv[1:])
        words = [word for word in sys.argv[1:] if not word.startswith("-")]
        context = getattr(error, "ctx", None)
        path = "" if context is None else context.command_path.removeprefix(context.find_root().command_path)
        usage = UsageError(error.format_message(), f"`{name}{path} -h` shows what it takes.")
        if usage.message:
            _write(Result.from_error(words[0] if words else name, usage), "json" if as_json else "human")
        return EXIT_USAGE
    except OSError as error:  # the help text, on a full disk or a closed pipe
        failure = StorageError(f"the output cannot be written: {error.strerror or error}")
        return _write(Result.from_error(name, failure), "human").exit_code
    except (KeyboardInterrupt, typer.Abort):
        return EXIT_INTERRUPTED
    return code if isinstance(code, int) else 0


def _set_up_logging(terminal: Terminal) -> None:
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(terminal.verbose, 2)]
    handler = logging.StreamHandler()
    handler.setFormatter(_Harmless("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


class _Harmless(logging.Formatter):
    """A log line with control characters escaped, because it contains file names and device data."""

    def format(self, record: logging.LogRecord) -> str:
        """The line; its line feeds are kept."""
        return visible(super().format(record))


def announce(
    terminal: Terminal, name: str, facts: dict[str, Any], before: Sequence[str], after: Sequence[str] = ()
) -> None:
    """Print immediately where a command listens, `url` of its facts: the user needs it while it runs.

    As JSON it is one line; as text the URL is on a line of its own on stdout, the lines before and after it
    on stderr.
    """
    as_json = terminal.output is Output.json
    shown = not (as_json or terminal.quiet)
    for line in before if shown else ():
        typer.echo(line, err=True)
    typer.echo(json.dumps(Result(name, facts).envelope()) if as_json else str(facts["url"]))
    for line in after if shown else ():
        typer.echo(line, err=True)


def to_copy(urls: Sequence[str], command: str) -> Text:
    """Device URLs, one per line for copying, and the next command with the first of them in place of {}.

    Lines are not wrapped, so that a URL can be copied completely.
    """
    from rich.text import Text

    lines = [*urls, "next: " + next_command(urls[0], command)] if urls else []
    return Text("\n".join(lines), no_wrap=True, overflow="ignore")


def next_command(url: str, command: str) -> str:
    """A command with a URL in place of {}, quoted for a shell if necessary.

    >>> next_command("roomba+serial:///dev/ttyUSB1?step=2", "tagid motion info {}")
    "tagid motion info 'roomba+serial:///dev/ttyUSB1?step=2'"
    """
    return command.format(shlex.quote(url))
