"""`tagid-firmware verify`: compare the board with the build."""

from __future__ import annotations

from dataclasses import asdict

from firmware_tools.cli import shared
from tagid.cli.frame import Terminal, command
from tagid.errors import EXIT_FAILED, EXIT_OK
from tagid.result import Problem, Result


@command("verify")
def verify(terminal: Terminal, port: shared.PortOption = None, build: shared.BuildFolder = None) -> Result:
    """Compare the board with a build by hash; show versions, configuration and ports.

    It stops the bridge's program temporarily and restarts it.

    Example: tagid-firmware verify --build build/bridge
    """
    from rich.table import Table

    from firmware_tools.board import open_board
    from firmware_tools.boards import choose_port, ports
    from firmware_tools.cli.shared import load_build
    from firmware_tools.provision import compare

    chosen = choose_port(port)
    made = load_build(build, terminal)
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
