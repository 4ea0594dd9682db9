"""`tagid-firmware p440`: check and store a P440's settings; never writes the radar's firmware."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.errors import EXIT_FAILED, EXIT_OK
from tagid.result import Problem, Result

Whole = int | None


@command("p440")
def p440(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    store: Annotated[bool, typer.Option("--store", help="Keep the settings in the radar's flash.")] = False,
    start: Annotated[
        Whole, typer.Option("--start-ps", help="Start of the window, ps.", show_default=False)
    ] = None,
    stop: Annotated[
        Whole, typer.Option("--stop-ps", help="End of the window, ps.", show_default=False)
    ] = None,
    node: Annotated[Whole, typer.Option("--node", help="The radar's number.", show_default=False)] = None,
    code: Annotated[
        Whole, typer.Option("--code-channel", help="Code channel, 0 to 10.", show_default=False)
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
