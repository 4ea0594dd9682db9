"""`tagid plan`: predict the quality of a recording before building a tag."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES
from tagid.config import load_config
from tagid.counting import meant
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.planning.plan import Plan, Setup, Wanted
    from tagid.planning.rates import Expected
    from tagid.result import Drawn


@dataclass(frozen=True)
class PlanOptions:
    reflector: Annotated[str, typer.Option(help="Reflectors of the tag, size from tip to tip.")] = (
        "octahedron:40mm"
    )
    body: options.Body = None
    distance: Annotated[
        float | None,
        typer.Option(parser=METRES, help="Antennas to rotation axis, metres (default: the setting, or 1)."),
    ] = None
    pii: Annotated[
        int | None,
        typer.Option("--integration", "--pii", help="Integration index (default: radar.integration)."),
    ] = None
    gain: Annotated[int | None, typer.Option(help="Transmit gain, 0 to 63 (default: radar.gain).")] = None
    rpm: Annotated[float, typer.Option(help="Turns per minute.")] = 2.0
    layout: Annotated[str, typer.Option("--layout", "--layouts", help="Layout of the tag.")] = "container-90"
    file: options.LayoutFile = None
    enrolled: Annotated[
        bool, typer.Option("--enrolled", help="The untagged body is enrolled (tagid enroll --body).")
    ] = False

    def setup(self) -> Setup:
        """The setup, with the rest from the configuration. Raises UsageError, ConfigError."""
        from tagid.config import data_folder
        from tagid.enrolling.layout_file import named_layouts
        from tagid.planning.plan import Setup
        from tagid.rig import installed_profile
        from tagid.simulate.budget import LinkBudget
        from tagid.simulate.specification import parse_body, parse_reflector

        config = load_config(
            {"motion.axis_distance_m": self.distance, "radar.integration": self.pii, "radar.gain": self.gain}
        )
        layouts = named_layouts(self.file, data_folder() / "registry.sqlite")
        if self.layout not in layouts:
            raise UsageError(
                f"no layout is named {self.layout[:80]!r}",
                f"{meant(self.layout, layouts)}Use {', '.join(sorted(layouts))}.",
            )
        rig = installed_profile(data_folder())
        return Setup(
            layouts[self.layout],
            parse_reflector(self.reflector),
            parse_body(self.body or "none"),
            config["motion.axis_distance_m"] or 1.0,
            self.rpm,
            LinkBudget.on(rig, config["radar.gain"], config["radar.integration"]),
            config["imaging.extent_m"],
            self.enrolled,
            None if rig is None else rig.pulse,
        )


@command("plan")
def plan(
    terminal: Terminal,
    asked: PlanOptions,
    want: Annotated[
        float | None,
        typer.Option(help="Required identification rate, e.g. 0.99: find settings that reach it."),
    ] = None,
) -> Result:
    """Plan a recording: SNR, clipping, time, centring, and the probability that the tag is named.

    Every number of the link budget is listed with its source.

    Example: tagid plan --reflector octahedron:40mm --body can:35mm --distance 1.0 --integration 11 --rpm 2
    Example: tagid plan --reflector octahedron:20mm --want 0.99
    """
    from tagid.planning.plan import invert, planned_snr_db
    from tagid.planning.plan import plan as work_out

    setup = asked.setup()
    planned = work_out(setup)
    wanted = None if want is None else invert(setup, want)
    snr = planned_snr_db(setup)
    data: dict[str, Any] = {**_data(planned), "snr_db": snr, "wanted": None}
    doubt = ""
    if wanted is not None and want is not None:
        changes = {"reflector": wanted.plan, "distance": wanted.distance, "integration": wanted.integration}
        data["wanted"] = {name: change and _data(change) for name, change in changes.items()}
        data["wanted_remark"] = doubt = _doubt(planned, wanted, want)
    return Result("plan", data, _drawn(planned, snr, wanted, want, doubt))


def _data(planned: Plan) -> dict[str, Any]:
    setup, rates = planned.setup, planned.rates
    return {
        "reflector": str(setup.reflector),
        "body": str(setup.body),
        "layout": setup.layout.name,
        "distance_m": setup.distance_m,
        "integration": setup.budget.integration,
        "rpm": setup.rpm,
        "rcs_dbsm": planned.rcs_dbsm,
        "snr_sample_db": planned.snr_sample_db,
        "snr_view_db": planned.snr_view_db,
        "body_over_reflector_db": planned.body_db,
        "clipping_margin_db": planned.margin_db,
        "scans_per_turn": planned.scans_per_turn,
        "views": planned.views,
        "turn_s": planned.turn_s,
        "recording_s": planned.recording_s,
        "centre_m": planned.centre_m,
        "body_moves_beyond_m": planned.moved_m,
        "body_enrolled": setup.enrolled,
        "rates": _rates_data(rates),
        "rates_if_enrolled": None if planned.if_enrolled is None else _rates_data(planned.if_enrolled),
        "rates_source": rates.source,
        "rates_scenes": rates.scenes,
        "rates_note": rates.note,
        "budget": [
            {"name": t.name, "value": t.value, "unit": t.unit, "source": t.source}
            for t in setup.budget.terms()
        ],
    }


def _rates_data(rates: Expected) -> dict[str, list[float]]:
    shares = {name: getattr(rates, name) for name in ("named", "refused", "wrong")}
    return {name: [share.value, share.low, share.high] for name, share in shares.items()}


def _doubt(planned: Plan, wanted: Wanted, want: float) -> str:
    """What to do if no setup reaches a rate, or that the table cannot promise it; otherwise ""."""
    from tagid.proportion import trials_for

    plans = filter(None, (wanted.plan, wanted.distance, wanted.integration))
    lowest = min(plans, key=lambda alternative: alternative.rates.named.low, default=None)
    if lowest is None:
        enrolled = planned.if_enrolled
        if enrolled is None or enrolled.named.value < want:
            return (
                "no setup reaches this rate: use a bare mount, another body, or read the object several times"
            )
        return f"enroll the untagged body (`tagid enroll --help`): then named {enrolled.named}"
    if lowest.rates.named.low >= want:
        return ""
    rates = lowest.rates
    return (
        f"the table cannot promise {100 * want:g} %: with {rates.scenes} scenes, the 95 % interval goes down "
        f"to {100 * rates.named.low:.0f} % ({trials_for(want)} scenes, all named, would be needed); "
        "leave a margin (a larger reflector, more integration) and check it with repeated scans"
    )


def _drawn(planned: Plan, snr: float, wanted: Wanted | None, want: float | None, doubt: str) -> Drawn:
    from rich.text import Text

    from tagid.report.table import Table

    def table(rows: Iterable[Sequence[str | Text]]) -> Table:
        made = Table(rows=rows)
        made.columns[0].no_wrap = True
        return made

    budget = [
        (term.name, f"{term.value:.4g} {term.unit}", Text(term.source, style="dim"))
        for term in planned.setup.budget.terms()
    ]
    parts: list[Drawn] = [Text("link budget", "bold"), table(budget)]
    parts += [Text("recording", "bold"), table(_rows(planned, snr))]
    if wanted is not None and want is not None:
        parts += [
            Text(f"expected to be named in {100 * want:g} % of readings, one change at a time", "bold"),
            table(_reached(wanted)),
        ]
        if doubt:
            parts.append(Text(doubt, "yellow"))
    return parts


def _rows(planned: Plan, snr: float) -> list[tuple[str, str]]:
    setup = planned.setup
    rows = [
        (
            "reflector",
            f"{setup.reflector} (tip to tip), {planned.rcs_dbsm:.1f} dBsm; layout {setup.layout.name}",
        ),
        ("SNR", f"{snr:.1f} dB at {setup.distance_m:.4g} m, as `tagid show` measures it"),
        ("per reflector", f"peak {planned.snr_sample_db:.1f} dB over the noise of one sample"),
        (
            "averaging",
            f"{planned.snr_view_db - planned.snr_sample_db:+.1f} dB: "
            f"{planned.scans_per_turn} scans in {planned.views} views",
        ),
    ]
    if planned.body_db is not None:
        rows.append(("body", f"{setup.body}, {planned.body_db:+.1f} dB over one reflector"))
    clip = "" if planned.margin_db > 0 else ": CLIPS, lower the gain or the integration"
    rows += [
        ("clipping margin", f"{planned.margin_db:.1f} dB{clip}"),
        ("time", f"{planned.turn_s:.1f} s per revolution, {planned.recording_s:.1f} s recorded"),
        ("centring", f"within {planned.centre_m * 1e3:.0f} mm of the rotation axis"),
    ]
    if planned.moved_m is not None:
        rows.append(
            ("", f"beyond {planned.moved_m * 1e3:.1f} mm the echo of the moving body exceeds a reflector's")
        )
    rows += _rates_rows("expected, body enrolled" if setup.enrolled else "expected", planned.rates)
    if planned.if_enrolled is not None:
        rows += _rates_rows("body enrolled", planned.if_enrolled)
    return rows


def _rates_rows(name: str, rates: Expected) -> list[tuple[str, str]]:
    return [
        (name, f"named {rates.named}, refused {rates.refused}, wrong {rates.wrong}"),
        ("", f"simulated: {rates.source}; {rates.scenes} scenes" + (f"; {rates.note}" if rates.note else "")),
    ]


def _reached(wanted: Wanted) -> list[tuple[str, str]]:
    """What reaches the rate by one change alone, line by line."""

    def row(name: str, alternative: Plan | None, none: str, words: Callable[[Plan], str]) -> tuple[str, str]:
        if alternative is None:
            return name, none
        rates = alternative.rates
        return name, f"{words(alternative)}: named {rates.named}, {rates.scenes} scenes"

    return [
        row("reflector", wanted.plan, "none up to 60 mm", lambda it: f"{it.setup.reflector} or larger"),
        row(
            "distance",
            wanted.distance,
            "none beyond 0.6 m",
            lambda it: f"{it.setup.distance_m:g} m or closer",
        ),
        row(
            "integration",
            wanted.integration,
            "none",
            lambda it: f"--integration {it.setup.budget.integration} or more, {it.views} views",
        ),
    ]
