"""`robotctl faults`: provoke every fault there is a protection for, and measure what follows."""

from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.trials.campaign import Campaign, Row, run_campaign
from robotctl.trials.report import as_json, figure, write_section
from robotctl.trials.scenario import TITLES
from robotctl.trials.scenarios import scenarios


def faults(
    backend: Annotated[str, typer.Option(help="sim: the MuJoCo twin. can: emulated motors behind CAN frames.")] = "sim",
    robot: Annotated[str, typer.Option(help="Name of a shipped robot, or path of a profile.")] = "panda",
    only: Annotated[str, typer.Option(help="One protection, e.g. P12.")] = "",
    json: Annotated[Path | None, typer.Option(help="Write the report here.")] = None,
    report: Annotated[Path | None, typer.Option(help="Markdown file whose section of this robot is replaced.")] = None,
) -> None:
    """Provoke every fault on a simulated arm. Exit status 3 if one is not met as it has to be."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        number = _number(only)
        rows: list[Row] = []

        with Live(console=console, auto_refresh=False, vertical_overflow="visible") as live:

            def show(row: Row) -> None:
                if row not in rows:
                    rows.append(row)
                live.update(_table(rows, f"{model.profile.title} on {backend}"), refresh=True)

            campaign = run_campaign(model, backend, scenarios(model, backend), show, number)
        _tell_problems(console, campaign)
        if json is not None:
            write_json(json, as_json(campaign))
        if report is not None:
            write_section(report, campaign)
    if not campaign.passed:
        raise typer.Exit(Exit.STOPPED_BY_SAFETY)


def _number(only: str) -> int | None:
    if not only:
        return None
    text = only.upper().removeprefix("P")
    if not text.isdigit() or int(text) not in TITLES:
        raise ConfigError(f"unknown protection {only!r}", f"use one of P1 to P{max(TITLES)}")
    return int(text)


def _table(rows: list[Row], title: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("", "scenario", "", "reaction", "standstill", "way", ""):
        table.add_column(
            heading, overflow="fold", justify="right" if heading in ("reaction", "standstill", "way") else "left"
        )
    for row in rows:
        scenario = row.scenario
        if len(row.trials) < scenario.repeats:
            mark = f"[yellow]{len(row.trials)}/{scenario.repeats}[/]"
        else:
            mark = "[green]pass[/]" if row.passed else "[bold red]FAIL[/]"
        seen = row.trials[0].seen if row.trials else ""
        table.add_row(
            scenario.label,
            escape(scenario.name),
            mark,
            _worst(row, "reaction_s", "ms"),
            _worst(row, "standstill_s", "ms"),
            _worst(row, "tool_way_m", "mm"),
            escape(seen),
        )
    return table


def _worst(row: Row, name: str, unit: str) -> str:
    found = figure(row, name)
    return "" if found is None else f"{1e3 * found[1]:.0f} {unit}"


def _tell_problems(console: Console, campaign: Campaign) -> None:
    for row in campaign.rows:
        for problem in row.problems:
            console.print(f"[red]{row.scenario.label}[/] {escape(row.scenario.name)}: {escape(problem)}")
    if campaign.missing:
        names = ", ".join(f"P{number} {TITLES[number]}" for number in campaign.missing)
        console.print(f"[red]without a scenario[/]: {names}")
    passed = sum(row.passed for row in campaign.rows)
    console.print(f"{passed} of {len(campaign.rows)} scenarios passed")
