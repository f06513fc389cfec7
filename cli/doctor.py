"""`robotctl doctor`: is this machine, this profile and this bus fit to move an arm?"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.can.channel import open_channel
from robotctl.hal.can.diagnosis import drive_findings, drives_of, profile_findings
from robotctl.hal.can.scan import LAST_ID, scan
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import BusError
from robotctl.hal.host import Finding, Level, host_findings
from robotctl.hal.robot import Robot, load_robot

_COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "bold red"}


def doctor(
    robot: Annotated[str, typer.Option(help="Name of a shipped robot, or path of a profile.")] = "panda",
    channel: Annotated[
        str, typer.Option(help="Look at the drives too: emulated, virtual:NAME, socketcan:can0, slcan:DEVICE.")
    ] = "",
    json: Annotated[Path | None, typer.Option(help="Write the findings here.")] = None,
) -> None:
    """Examine host, profile and drives. Changes nothing; exit status 4 if the drives are unfit, 2 if the profile is."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        clock = MonotonicClock()
        findings = host_findings(clock) + profile_findings(model)
        if channel:
            findings += _look_at_drives(model, clock, channel)
        console.print(_table(findings, model))
        if json is not None:
            entries = [finding._asdict() for finding in findings]
            write_json(json, {"robot": model.profile.name, "channel": channel, "findings": entries})
    failed = {finding.area for finding in findings if finding.level is Level.FAIL}
    if failed:
        raise typer.Exit(Exit.NO_HARDWARE if failed & {"drives", "host"} else Exit.BAD_INPUT)


def _look_at_drives(robot: Robot, clock: MonotonicClock, channel: str) -> list[Finding]:
    try:
        opened = open_channel(channel, robot, clock)
    except BusError as error:
        return [Finding("drives", channel, Level.FAIL, error.what, error.remedy)]
    try:
        last = max([LAST_ID, *(drive.id for _, drive, _ in drives_of(robot))])
        return drive_findings(robot, scan(opened, clock, last))
    except BusError as error:
        return [Finding("drives", channel, Level.FAIL, error.what, error.remedy)]
    finally:
        opened.bus.shutdown()


def _table(findings: list[Finding], robot: Robot) -> Table:
    table = Table(title=f"fit for {robot.profile.title}?", show_lines=False)
    for heading in ("", "what", "", "found"):
        table.add_column(heading, overflow="fold")
    area = ""
    for finding in findings:
        if area not in ("", finding.area):
            table.add_section()
        shown = finding.area if finding.area != area else ""
        area = finding.area
        text = escape(finding.text) + (f"\n[dim]try: {escape(finding.remedy)}[/]" if finding.remedy else "")
        colour = _COLOURS[finding.level]
        table.add_row(shown, escape(finding.name), f"[{colour}]{finding.level}[/]", text)
    return table
