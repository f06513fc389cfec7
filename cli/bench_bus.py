"""`robotctl bench bus`: what a cycle of all drives costs, beside bare python-can."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from robotctl.cli.errors import readable_errors
from robotctl.cli.output import write_json
from robotctl.control.registry import claimed
from robotctl.hal.can.channel import open_channel
from robotctl.hal.can.damiao.benchmark import bench_bus
from robotctl.hal.clock import MonotonicClock, VirtualClock
from robotctl.hal.robot import load_robot


def bus(
    channel: Annotated[str, typer.Option(help="emulated, socketcan:can0, slcan:DEVICE.")] = "emulated",
    robot: Annotated[str, typer.Option(help="Robot whose drives are on the channel; they stay off.")] = "openarm",
    cycles: Annotated[int, typer.Option(min=100, help="Cycles of either kind.")] = 5000,
    json: Annotated[Path | None, typer.Option(help="Write the figures and the stages' histogram here.")] = None,
) -> None:
    """Time a cycle of all drives on a bus, stage by stage, beside bare python-can. Enables nothing."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        # Emulated drives follow whatever clock they are given.
        clock = VirtualClock() if channel == "emulated" else MonotonicClock()
        with claimed(channel):
            opened = open_channel(channel, model, clock)
            try:
                report = {"robot": robot, "channel": channel, **bench_bus(model, clock, opened, cycles)}
            finally:
                opened.close()
        table = Table(title=f"{report['motors']} drives on {channel}, {cycles} cycles, microseconds")
        for column in ("what", "p50", "p99", "max"):
            table.add_column(column, justify="left" if column == "what" else "right")
        stages = report["stages_us"]
        for what, cost in {**stages, "bare python-can": report["bare_us"], "cycle": report["cycle_us"]}.items():
            table.add_row(what, *(f"{cost[key]:.1f}" for key in ("p50", "p99", "max")))
        table.add_section()
        table.add_row("[bold]ratio[/]", f"[bold]{report['ratio']:.2f}[/]", "", "")
        console.print(table)
        missed = report["missed"]
        console.print(f"replies missed: {missed['ours']}, bare {missed['bare']}; ", end="")
        console.print(f"on a wire the frames take {report['wire_us']:.0f} us")
        if json is not None:
            write_json(json, report)
