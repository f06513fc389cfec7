"""`robotctl bench endurance`: a long run on a bus that loses, delays and doubles frames."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.trials.endurance import drifts, endure


def endurance(
    ticks: Annotated[int, typer.Option(min=1000, help="Servo ticks; an hour at 500 Hz by default.")] = 1_800_000,
    robot: Annotated[str, typer.Option(help="Robot with CAN drives.")] = "openarm",
    share: Annotated[float, typer.Option(min=0.0, max=0.5, help="Of frames that are lost, late or doubled.")] = 0.01,
    seed: Annotated[int, typer.Option(min=0, help="Of policy and trouble.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the result here.")] = None,
) -> None:
    """Move emulated drives in lockstep over a bad bus; status 3 if anything stops, breaks a limit, or grows."""
    console = Console(highlight=False, soft_wrap=True)

    def show(look: dict[str, Any]) -> None:
        console.print(f"{look['ticks']:9d} ticks  {look['rss_mb']:7.1f} MB  {look['descriptors']:3d} descriptors")

    with readable_errors():
        model = load_robot(robot)
        if model.profile.can is None:
            raise ConfigError(f"robot {robot!r} has no CAN drives", "use one with drives, such as openarm")
        result = endure(model, ticks, share, seed, show)
        frames, violations = result["frames"], sum(result["violations"].values())
        console.print(f"{result['ticks']} ticks ({result['simulated_s']:g} s), {frames['sent']} frames sent, ", end="")
        console.print(f"{frames['received']} received, {frames['missed_replies']} replies missed")
        console.print(f"{len(result['stops'])} stops, {violations} violations; grown by ", end="")
        console.print(f"{result['rss_growth_mb']} MB and {result['descriptor_growth']} descriptors")
        for stop in result["stops"]:
            console.print(f"  {stop}", markup=False)
        if json is not None:
            write_json(json, result)
    if result["stops"] or violations or drifts(result):
        raise typer.Exit(Exit.STOPPED_BY_SAFETY)
