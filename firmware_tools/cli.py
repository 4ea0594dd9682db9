"""The program `tagid-firmware`: builds and installs the bridge on an ESP32, and configures a P440."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command, commands_of, run_program
from tagid.errors import EXIT_FAILED, EXIT_OK
from tagid.result import Problem, Result

if TYPE_CHECKING:
    from firmware_tools.build import Build

_Port = Annotated[
    str | None,
    typer.Option("--port", help="The board's serial port; default: the only board.", show_default=False),
]
_BuildFolder = Annotated[
    Path | None,
    typer.Option(
        "--build", help="Folder of a build; if omitted, the firmware is built now.", show_default=False
    ),
]


def _load_build(folder: Path | None, terminal: Terminal) -> Build:
    """The build in a folder, or a new one."""
    from firmware_tools.build import compile_firmware, read_build

    if folder is not None:
        return read_build(folder)
    with terminal.progress("building", None) as advance:
        return compile_firmware(advance)


@command("build")
def build(
    terminal: Terminal,
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("build/bridge"),
) -> Result:
    """Compile the bridge's firmware with mpy-cross, with a manifest of hashes.

    Example: tagid-firmware build --out build/bridge
    """
    from rich.table import Table

    from firmware_tools.build import write_build

    made = _load_build(None, terminal)
    write_build(made, out)
    table = Table("file", "bytes", "sha256", box=None)
    for name, content in made.files.items():
        table.add_row(name, str(len(content)), made.hashes[name][:16])
    data = {"folder": str(out), **made.manifest()}
    note = f"firmware {made.version} is in {out}; next: tagid-firmware flash IMAGE"
    return Result("build", data, table, messages=(note,))


@command("flash")
def flash(
    terminal: Terminal,
    image: Annotated[Path, typer.Argument(help="MicroPython's .bin for ESP32_GENERIC or _C3.")],
    port: _Port = None,
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", help="Its hash; without it IMAGE.sha256 is read.", show_default=False),
    ] = None,
    baud: Annotated[int, typer.Option("--baud", help="Baud rate for writing.")] = 460800,
    before: Annotated[
        str, typer.Option("--before", help="default-reset, usb-reset, or no-reset (BOOT held by hand).")
    ] = "default-reset",
    stub: Annotated[bool, typer.Option("--stub/--no-stub", help="Load esptool's faster helper.")] = True,
    erase: Annotated[bool, typer.Option("--erase", help="Erase everything first.")] = False,
) -> Result:
    """Write an official MicroPython image; its hash is checked before, and its content read back after.

    Example: tagid-firmware flash ESP32_GENERIC_C3-v1.27.0.bin --sha256 HASH
    """
    from firmware_tools import flash as flashing
    from firmware_tools.board import choose_port
    from tagid.errors import UsageError

    if before not in ("default-reset", "usb-reset", "no-reset"):
        raise UsageError(f"--before {before!r} is unknown", "Give default-reset, usb-reset or no-reset.")
    checked = flashing.check_image(image, flashing.wanted_hash(image, sha256))
    connection = flashing.Connection(choose_port(port), baud, before, stub)
    with terminal.progress("flashing", len(checked.data)) as advance:
        done = flashing.flash(checked, connection, advance, erase)
    data = {
        "port": connection.port,
        "image": {"path": str(image), "sha256": checked.sha256, "micropython": checked.version},
        **asdict(done),
    }
    text = (
        f"MicroPython {checked.version or '(version unknown)'} is on the {done.chip} {done.mac}: "
        f"{done.size} bytes at {done.offset:#x}, read back and equal"
    )
    return Result("flash", data, text, messages=("next: tagid-firmware provision --name NAME",))


@command("provision")
def provision(
    terminal: Terminal,
    name: Annotated[str, typer.Option("--name", help="Advertised name, up to 20 characters.")],
    chip: Annotated[str, typer.Option("--chip", help="esp32 or esp32c3: sets the pins.")] = "esp32c3",
    passkey: Annotated[
        str | None,
        typer.Option("--passkey", help="Six digits; random if omitted.", show_default=False),
    ] = None,
    baud: Annotated[
        int | None, typer.Option("--baud", help="Robot's baud rate; default 115200.", show_default=False)
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="JSON file with further keys (docs/bridge.md).", show_default=False),
    ] = None,
    port: _Port = None,
    build: _BuildFolder = None,
) -> Result:
    """Write the firmware and its configuration; identical files are kept.

    Example: tagid-firmware provision --name robot-7 --chip esp32c3
    """
    from firmware_tools import provision as provisioning
    from firmware_tools.board import choose_port, open_board

    given = {"name": name, "baud": baud, "passkey": passkey}
    wanted = provisioning.make_config(chip, given, config)
    random = wanted["passkey"] is None and not _open_on_purpose(config)
    if random:
        wanted = provisioning.make_config(chip, {**given, "passkey": provisioning.new_passkey()}, config)
    made = _load_build(build, terminal)
    chosen = choose_port(port)
    total = sum(len(data) for data in made.files.values())
    with open_board(chosen) as board, terminal.progress("writing", total) as advance:
        done = provisioning.provision(board, made, wanted, advance)
    data = {
        "port": chosen,
        "firmware": made.version,
        "python": asdict(done.python),
        "written": done.written,
        "kept": done.kept,
        "config": wanted,
    }
    key = wanted["passkey"]
    text = f"{name}: firmware {made.version}, {len(done.written)} files written, {len(done.kept)} kept; " + (
        f"pass-key {key}" if key else "open to anyone"
    )
    notes = ["write the pass-key on the board's label: it is not shown again"] if random else []
    if key is None:
        notes.append("without a pass-key anyone within range can drive the robot")
    notes.append(f"next: tagid-firmware selftest {name}" + (f" --passkey {key}" if key else ""))
    return Result("provision", data, text, messages=tuple(notes))


def _open_on_purpose(path: Path | None) -> bool:
    """Whether the file itself contains `"passkey": null`."""
    return path is not None and "passkey" in json.loads(path.read_text(encoding="utf-8"))


@command("verify")
def verify(terminal: Terminal, port: _Port = None, build: _BuildFolder = None) -> Result:
    """Compare the board with a build by hash; show versions, configuration and ports.

    It stops the bridge's program temporarily and restarts it.

    Example: tagid-firmware verify --build build/bridge
    """
    from rich.table import Table

    from firmware_tools.board import choose_port, open_board, ports
    from firmware_tools.provision import compare

    chosen = choose_port(port)
    made = _load_build(build, terminal)
    with open_board(chosen) as board, terminal.progress("comparing", len(made.files)) as advance:
        comparison = compare(board, made, advance)
        board.restart()
    table = Table(show_header=False, box=None)
    table.add_row(
        "board", f"{comparison.python.machine}, MicroPython {comparison.python.version}, on {chosen}"
    )
    table.add_row("build", f"firmware {made.version}, {made.compiler}")
    for name, verdict in comparison.files.items():
        table.add_row(name, verdict, style=None if verdict == "same" else "red")
    table.add_row(
        "configuration", comparison.problem or f"valid, name {(comparison.config or {}).get('name')}"
    )
    table.add_row(
        "pass-key", "set" if comparison.passkey else "none: anyone within range can drive the robot"
    )
    data = {
        "port": chosen,
        "ports": [asdict(item) for item in ports()],
        "build": {"version": made.version, "compiler": made.compiler},
        "good": comparison.good,
        **asdict(comparison),
    }
    wrong = [f"{name} {verdict}" for name, verdict in comparison.files.items() if verdict != "same"]
    if comparison.problem:
        wrong.append(f"configuration: {comparison.problem}")
    errors = tuple(Problem("firmware", text, "Run `tagid-firmware provision` again.") for text in wrong)
    notes = tuple(f"{name} on the board is not part of this build" for name in comparison.extra)
    code = EXIT_OK if comparison.good else EXIT_FAILED
    return Result("verify", data, table, exit_code=code, messages=notes, errors=errors)


_STYLES = {"passed": "green", "failed": "bold red", "skipped": "yellow"}


@command("selftest")
def selftest(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name or address of the bridge.")],
    passkey: Annotated[
        str | None, typer.Option("--passkey", help="Its six-digit pass-key.", show_default=False)
    ] = None,
    loopback: Annotated[bool, typer.Option("--loopback", help="TX and RX are connected.")] = False,
    brc: Annotated[bool, typer.Option("--brc/--no-brc", help="Pulse BRC, which wakes the robot.")] = True,
    listen: Annotated[
        float, typer.Option("--listen", min=0.1, max=60, help="Duration of the search, s.")
    ] = 5.0,
    hci: Annotated[
        str | None,
        typer.Option("--hci", help="A virtual controller instead of this computer's.", show_default=False),
    ] = None,
) -> Result:
    """Find the bridge, then test link, echo, serial line, BRC and the robot's answer. No wheel moves.

    Example: tagid-firmware selftest robot-7 --passkey 482913
    """
    from rich.table import Table

    from firmware_tools.selftest import SelftestPlan, run_selftest

    plan = SelftestPlan(name, passkey, loopback, brc, listen)
    with terminal.progress("testing", 5) as advance:
        steps = run_selftest(plan, advance, hci)
    table = Table(show_header=False, box=None)
    for step in steps:
        table.add_row(step.name, step.verdict, step.text, style=_STYLES[step.verdict])
    bad = [step for step in steps if step.verdict == "failed"]
    return Result(
        "selftest",
        {"name": name, "steps": [asdict(step) for step in steps]},
        table,
        exit_code=EXIT_FAILED if bad else EXIT_OK,
        errors=tuple(Problem("selftest", f"{step.name}: {step.text}", "See docs/bridge.md.") for step in bad),
    )


_Whole = int | None


@command("p440")
def p440(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    store: Annotated[bool, typer.Option("--store", help="Keep the settings in the radar's flash.")] = False,
    start: Annotated[
        _Whole, typer.Option("--start-ps", help="Start of the window, ps.", show_default=False)
    ] = None,
    stop: Annotated[
        _Whole, typer.Option("--stop-ps", help="End of the window, ps.", show_default=False)
    ] = None,
    node: Annotated[_Whole, typer.Option("--node", help="The radar's number.", show_default=False)] = None,
    code: Annotated[
        _Whole, typer.Option("--code-channel", help="Code channel, 0 to 10.", show_default=False)
    ] = None,
) -> Result:
    """Print a P440's versions and compare its settings with tagid's; with --store, write tagid's to it.

    Integration, gain and antennas come from `tagid config`; other settings stay as they are unless given.

    Example: tagid-firmware p440 --radar udp://192.168.1.100 --store
    """
    from tagid.cli.radar import open_configured
    from tagid.config import load_config, radar_url
    from tagid.radar.survey import RadarSurvey
    from tagid.report.radar import info_table

    config = load_config({"radar.url": radar})
    with terminal.progress("asking", None) as advance, open_configured(config) as device:
        advance(0, "versions")
        status, before = device.status(), device.config
        given = {
            "base_integration_index": config["radar.integration"],
            "transmit_gain": config["radar.gain"],
            "antenna_mode": config["radar.antenna_mode"],
            "scan_start_ps": start,
            "scan_stop_ps": stop,
            "node_id": node,
            "code_channel": code,
        }
        wanted = replace(before, **{key: value for key, value in given.items() if value is not None})
        wanted = wanted.quantised()
        differs = [key for key in given if getattr(before, key) != getattr(wanted, key)]
        after = before
        if store:
            advance(1, "storing")
            after = device.set_config(replace(wanted, persist=1))
        survey = RadarSurvey(status, device.get_opmode(), device.get_sleep_mode(), after, device.uptime_s())
    refused = [key for key in given if store and getattr(after, key) != getattr(wanted, key)]
    data = {
        "url": radar_url(config),
        "status": asdict(status),
        "before": asdict(before),
        "wanted": asdict(wanted),
        "after": asdict(after),
        "differs": differs,
        "stored": store and not refused,
    }
    notes = survey.warnings()
    if differs and not store:
        notes.append(
            f"the radar differs from tagid's settings in {', '.join(differs)}; --store writes tagid's"
        )
    errors = [
        Problem(
            "device_rejected",
            f"the radar took {getattr(after, key)} for {key}, not {getattr(wanted, key)}",
            "Choose a value that the radar supports.",
        )
        for key in refused
    ]
    if status.built_in_test:
        failed = f"the self test of the radar failed (code {status.built_in_test})"
        errors.append(Problem("device", failed, "Power-cycle the radar."))
    return Result(
        "p440",
        data,
        info_table(radar_url(config), survey),
        exit_code=EXIT_FAILED if errors else EXIT_OK,
        messages=tuple(notes),
        errors=tuple(errors),
    )


app = typer.Typer(
    name="tagid-firmware",
    help="Build, flash, provision and test the Bluetooth bridge; configure a P440.",
    epilog="In this order: build, flash, provision, verify, selftest.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for declared in commands_of(__name__):
    declared.add_to(app)


def main() -> None:
    """Entry point."""
    run_program(app)


if __name__ == "__main__":
    main()
