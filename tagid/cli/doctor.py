"""`tagid doctor`: find problems on this computer, and suggest remedies."""

from __future__ import annotations

from dataclasses import asdict

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.config import load_config
from tagid.errors import EXIT_FAILED, EXIT_OK
from tagid.result import Problem, Result


@command("doctor")
def doctor(terminal: Terminal, radar: options.RadarUrl = None) -> Result:
    """Check ports, radar, disk, layouts and versions.

    Example: tagid doctor --radar udp://192.168.1.100
    """
    from rich.text import Text

    from tagid.doctor import examine

    findings = examine(load_config({"radar.url": radar}), needs_radar=radar is not None)
    styles = {"ok": "green", "warning": "yellow", "problem": "bold red"}
    text = Text()
    for finding in findings:
        text.append(f"{finding.level:8}", style=styles[finding.level])
        text.append(f" {finding.topic:14} {finding.text}\n")
        if finding.remedy:
            text.append(f"         -> {finding.remedy}\n", style="bold")
    text.rstrip()
    problems = sum(finding.level == "problem" for finding in findings)
    return Result(
        "doctor",
        {"findings": [asdict(finding) for finding in findings], "problems": problems},
        text,
        exit_code=EXIT_FAILED if problems else EXIT_OK,
        errors=tuple(
            Problem("doctor", f"{f.topic}: {f.text}", f.remedy)
            for f in findings
            if f.level == "problem" and terminal.output == "json"
        ),
    )
