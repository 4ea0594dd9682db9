"""`tagid report`: identify many captures and write a report."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid import interrupts
from tagid.cli import options
from tagid.cli.frame import Output, Terminal, command
from tagid.cli.options import SECONDS
from tagid.config import load_config
from tagid.counting import counted
from tagid.errors import EXIT_INTERRUPTED, CaptureInterrupted, StorageError, UsageError, visible
from tagid.result import Problem, Result

if TYPE_CHECKING:
    from tagid.batch.job import Job
    from tagid.batch.local import Runner
    from tagid.batch.run import BatchPlan, Finished
    from tagid.report.records import ItemRecord
    from tagid.result import Drawn

_SHOWN_ERRORS = 10


@command("report")
def report(
    terminal: Terminal,
    inputs: Annotated[
        list[str] | None, typer.Argument(help="Folders, files or URLs of captures.", metavar="INPUT...")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report"),
    expect: Annotated[
        Path | None, typer.Option(help="CSV with file,expected_layout to compare with.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an earlier run and reuse its results.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier report.")] = False,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first failure.")] = False,
    watch: Annotated[
        Path | None, typer.Option(help="Identify new captures in this folder as they arrive.")
    ] = None,
    idle_stop: Annotated[
        float | None, typer.Option(parser=SECONDS, help="With --watch: stop after this many idle seconds.")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Worker processes; 0: one per core.")] = 0,
    dask: Annotated[str | None, typer.Option(help="Scheduler of a Dask cluster, tcp://HOST:PORT.")] = None,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw each object.")] = True,
    page_megabytes: Annotated[
        float, typer.Option(help="Size limit for all pictures of the page, MB.")
    ] = 32.0,
    title: Annotated[str, typer.Option(help="Title of the page.")] = "",
    method: options.Method = None,
    setup: options.RecordedOptions = options.RecordedOptions(),
) -> Result:
    """Identify many captures: write a page, tables and a test report.

    Pictures use backprojection unless --method or the configuration selects another method. Ctrl-C still
    writes a report of the finished items; --resume continues from there. A report of other captures is
    replaced only with --force, or after confirmation.

    Example: tagid report captures/ --out report --expect manifest.csv
    """
    from tagid.batch.expected import read_manifest
    from tagid.batch.inputs import Collected, collect, is_url
    from tagid.batch.job import Job
    from tagid.batch.run import BatchPlan
    from tagid.operate.workplace import Workplace
    from tagid.report.page import PageSettings

    if not inputs and watch is None:
        raise UsageError("nothing to identify", "Name folders, files or URLs, or use --watch FOLDER.")
    if idle_stop is not None and (watch is None or not idle_stop > 0):
        raise UsageError(
            f"--idle-stop {idle_stop:g} needs --watch and more than 0 seconds", "See `tagid report -h`."
        )
    config = load_config({"imaging.method": method, **setup.settings()})
    if any(not is_url(word) and Path(word).resolve() == out.resolve() for word in inputs or ()):
        raise UsageError(f"--out {out} is the folder that is read", "Choose another folder for the report.")
    page = PageSettings(title or PageSettings.title, page_megabytes)
    runner = _runner(terminal, jobs, dask)
    collected = collect(inputs, out) if inputs else Collected(())
    job = Job.of(Workplace(config, setup.background).setup(), pictures)
    plan = BatchPlan(collected, out, _watch(watch, out, idle_stop), page, None, resume, fail_fast)
    if expect is not None:
        names = [layout.name for layout in job.setup.enrolled.layouts]
        expected = read_manifest(expect, collected.sources, names, may_come=watch is not None)
        plan = replace(plan, expectations=expected)
    remarks = _check_earlier(plan, force)
    return _run(terminal, plan, job, runner, remarks)


def _runner(terminal: Terminal, jobs: int, dask: str | None) -> Runner:
    from tagid.batch.local import cores, run_local

    if dask is not None:
        from tagid.batch.cluster import run_cluster

        return partial(run_cluster, address=dask, verbose=terminal.verbose > 0)
    if not 0 <= jobs <= 1024:
        raise UsageError(f"--jobs is {jobs}", "Give 1 to 1024, or 0 for every core.")
    return partial(run_local, workers=jobs or cores())


def _watch(folder: Path | None, out: Path, idle_stop: float | None) -> Any:
    from tagid.batch.watch import FolderWatch

    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UsageError(
            f"--watch {folder} is not a folder", "Give the folder where captures arrive."
        ) from None
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error.strerror}", "Choose another.") from None
    return FolderWatch(folder, out, idle_stop_s=idle_stop)


def _check_earlier(plan: BatchPlan, force: bool) -> list[str]:
    """Agree to replace an earlier report in the folder, unless this run continues it.

    Returns remarks on its captures that are gone. Raises as `consent.agree_to_replace`, and StorageError.
    """
    from tagid.batch.inputs import is_url
    from tagid.batch.run import FILES
    from tagid.batch.spool import FILE_NAME, Spool
    from tagid.cli.consent import agree_to_replace

    out = plan.out
    paths = {name: out / name for name in (*FILES, FILE_NAME)}
    present = [name for name, path in paths.items() if path.is_file() and not path.is_symlink()]
    if not present:
        return []
    if FILE_NAME not in present:
        if not force:
            agree_to_replace(f"{out} holds a report", "Choose another --out, or add --force.")
        return []
    with Spool(out / FILE_NAME, fresh=False) as spool:
        names = spool.names()
    what = f"{out} holds a report of {counted(len(names), 'capture')}"
    if not plan.resume:
        if not force:
            agree_to_replace(what, "Choose another --out, continue it with --resume, or add --force.")
        return []
    missing = _missing(names, plan)
    not_inputs = [name for name in missing if is_url(name) or Path(name).exists()]
    if not_inputs and not force:
        agree_to_replace(
            f"{what}; not among the inputs: {len(not_inputs)}, e.g. {not_inputs[0]}",
            "Choose another --out, name the inputs of both, or add --force.",
        )
    gone = len(missing) - len(not_inputs)
    return [f"no longer in its place: {counted(gone, 'capture')} of the earlier report"] if gone else []


def _missing(names: list[str], plan: BatchPlan) -> list[str]:
    """Those of the names that are not among the inputs."""
    from tagid.batch.inputs import is_url

    locations = {source.location for source in plan.inputs.sources} | {
        source.name for source in plan.inputs.sources
    }
    watched = None if plan.watch is None else plan.watch.folder.absolute()
    return [
        name
        for name in names
        if name not in locations
        and str(path := Path(name).absolute()) not in locations
        and (is_url(name) or watched is None or watched not in path.parents or not path.exists())
    ]


def _run(terminal: Terminal, plan: BatchPlan, job: Job, runner: Runner, remarks: list[str]) -> Result:
    from tagid.batch.run import Hooks, run_batch
    from tagid.config import data_folder
    from tagid.storage.history import FILE_NAME

    lines = plan.watch is not None and not terminal.quiet and not sys.stderr.isatty()
    total = None if plan.watch else float(len(plan.inputs.sources))
    with interrupts.asked_to_stop() as stopped, terminal.progress("identify", total) as advance:

        def progress(done: int, of: int, rate: float, remaining_s: float | None) -> None:
            advance(float(done), _remark(done, of, rate, None if plan.watch else remaining_s))

        hooks = Hooks(progress, stopped, data_folder() / FILE_NAME, _item if lines else lambda record: None)
        finished = run_batch(plan, job, runner, hooks)
    return _result(terminal, plan, finished, remarks)


def _item(record: ItemRecord) -> None:
    """Write an item's line, where no bar shows that the run goes on."""
    from tagid.report.records import CAVEATS

    marks = "".join(f", {CAVEATS[name]}" for name in record.caveats)
    line = f"{record.file}: {record.answer.replace('_', ' ')}{marks}, {record.total_s:.2f} s"
    typer.echo(visible(line), err=True)


def _remark(done: int, of: int, rate: float, remaining_s: float | None) -> str:
    words = f"{done}/{of}, {rate:.2g}/s"
    if remaining_s is None:
        return words
    minutes, seconds = divmod(round(remaining_s), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f"{words}, {hours}:{minutes:02}:{seconds:02} left"
        if hours
        else f"{words}, {minutes}:{seconds:02} left"
    )


def _result(terminal: Terminal, plan: BatchPlan, finished: Finished, remarks: list[str]) -> Result:
    import json

    from rich.text import Text

    from tagid.batch.run import FILES
    from tagid.files import open_regular
    from tagid.report.records import qualified

    summary = finished.summary
    files = {name: str(plan.out / name) for name in FILES}
    data: dict[str, Any] = {"summary": summary, "files": files}
    failed = summary["by_status"]["failed"]
    errors: list[Problem] = []
    if failed or terminal.output is Output.json:
        items = []
        with open_regular(plan.out / "items.jsonl") as (lines, _):
            for line in lines:
                record = json.loads(line)
                if record["error"] and (terminal.output is Output.json or len(errors) < _SHOWN_ERRORS):
                    errors.append(Problem.from_json(record["error"]))
                if terminal.output is Output.json:
                    items.append(record)
        data["items"] = items
    messages = [*finished.remarks, *remarks, *_remarks(plan, finished)]
    if failed > len(errors):
        messages.append(f"{failed - len(errors)} more items failed; the report lists them")
    code = finished.exit_code
    if finished.interrupted:
        stop = CaptureInterrupted(
            f"stopped by the user after {summary['items']} of {summary['inputs']} items",
            f"The report in {plan.out} contains them; add --resume to continue.",
        )
        errors.append(Problem.of(stop))
        code = EXIT_INTERRUPTED
    counts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in summary["by_status"].items() if n)
    captures = counted(summary["captures"], "capture")
    lines_out: list[Drawn] = [Text.assemble((f"{captures}: ", "bold"), counts or "none")]
    if words := qualified(summary):
        lines_out.append(Text(words, "yellow"))
    if summary["expected"]:
        e = summary["expected"]
        accuracy = "-" if e["accuracy"] is None else f"{e['accuracy']:.1%}"
        lines_out.append(f"as expected: {e['correct']} of {e['items']} ({accuracy})")
    lines_out.append(f"report       {files['report.html']}")
    return Result(
        "report",
        data,
        lines_out,
        exit_code=code,
        messages=tuple(messages),
        errors=tuple(errors),
        completed=1,  # the report itself, whatever its items are
    )


def _remarks(plan: BatchPlan, finished: Finished) -> list[str]:
    remarks = []
    if finished.reused:
        remarks.append(f"reused from the earlier run: {counted(finished.reused, 'answer')}")
    for twin in finished.summary["duplicate_uuids"][:5]:
        what = "copies of one capture" if twin["same_content"] else "different files with one capture UUID"
        remarks.append(f"{what}, {twin['capture_uuid']}: {', '.join(twin['files'][:4])}")
    more = len(finished.summary["duplicate_uuids"]) - 5
    if more > 0:
        remarks.append(f"{more} more captures are in several files; summary.json lists them")
    if plan.inputs.passed_over:
        remarks.append(f"not recordings: {counted(len(plan.inputs.passed_over), 'file')} in the folders")
    under_way = plan.inputs.being_recorded
    if under_way:
        others = f" and {len(under_way) - 1} more" if len(under_way) > 1 else ""
        remarks.append(f"{under_way[0]}{others}: still being recorded, left out; add it later with --resume")
    links = plan.inputs.dangling
    remarks += [f"{link}: a link to a file that does not exist" for link in links[:5]]
    if len(links) > 5:
        remarks.append(f"{len(links) - 5} more links to files that do not exist; summary.json lists them")
    remarks += [f"cannot read folder {folder}" for folder in plan.inputs.unreadable[:5]]
    expected = finished.summary["expected"]
    if expected and expected["not_in_manifest"]:
        remarks.append(f"not in the manifest: {counted(expected['not_in_manifest'], 'file')}")
    return remarks
