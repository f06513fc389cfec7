"""`robotctl doctor`: is this machine, this profile and this bus fit to move an arm?"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.findings import print_findings
from robotctl.cli.output import write_json
from robotctl.control.registry import claimed
from robotctl.hal.can.diagnosis import channel_findings, profile_findings
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.host import Level, host_findings
from robotctl.hal.robot import load_robot


def doctor(
    robot: Annotated[str, typer.Option(help="Name of a shipped robot, or path of a profile.")] = "panda",
    channel: Annotated[
        str, typer.Option(help="Look at bus and drives, too: emulated, virtual:NAME, socketcan:can0, slcan:DEVICE.")
    ] = "",
    json: Annotated[Path | None, typer.Option(help="Write the findings here.")] = None,
) -> None:
    """Examine host, profile, bus and drives. Changes nothing; exit status 4 if the hardware is unfit, 2 the profile."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        clock = MonotonicClock()
        findings = host_findings(clock) + profile_findings(model)
        if channel:
            with claimed(channel):
                findings += channel_findings(model, clock, channel)
        print_findings(console, findings, f"fit for {model.profile.title}?")
        if json is not None:
            entries = [finding._asdict() for finding in findings]
            write_json(json, {"robot": model.profile.name, "channel": channel, "findings": entries})
    failed = {finding.area for finding in findings if finding.level is Level.FAIL}
    if failed:
        raise typer.Exit(Exit.NO_HARDWARE if failed & {"drives", "bus", "host"} else Exit.BAD_INPUT)
