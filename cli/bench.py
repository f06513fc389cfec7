"""`robotctl bench`: what things cost, as ratios measured in one run."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import mujoco
import typer
from rich.console import Console
from rich.table import Table

from robotctl.cli.errors import readable_errors
from robotctl.cli.output import write_json
from robotctl.control.benchmark import bench_tick
from robotctl.hal.robot import Robot, load_robot
from robotctl.sim.plant import PHYSICS_STEP_NS, Plant

bench_app = typer.Typer(help="Measure what things cost.", no_args_is_help=True)


@bench_app.callback()
def bench() -> None:
    """Measure what things cost."""


@bench_app.command()
def tick(
    robot: Annotated[str, typer.Option(help="Robot to measure.")] = "panda",
    ticks: Annotated[int, typer.Option(min=100, help="Ticks to time on each backend.")] = 5000,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Time one tick on the twin and on the emulated bus, beside the bare library calls."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        backends = ["sim", "can"] if model.profile.can else ["sim"]
        reports = {name: bench_tick(model, name, ticks, _physics(model)) for name in backends}
        for name, report in reports.items():
            table = Table(title=f"{robot} on {name}, {ticks} ticks, microseconds")
            for column in ("what", "p50", "p99"):
                table.add_column(column, justify="left" if column == "what" else "right")
            for what, cost in report["bare_us"].items():
                table.add_row(what, f"{cost['p50']:.1f}", f"{cost['p99']:.1f}")
            table.add_section()
            table.add_row("bare calls", f"{report['bare_sum_us']:.1f}", "")
            table.add_row("tick", f"{report['tick_us']['p50']:.1f}", f"{report['tick_us']['p99']:.1f}")
            table.add_row("[bold]ratio[/]", f"[bold]{report['ratio']:.2f}[/]", "")
            table.add_row("ratio without physics", f"{report['ratio_without_physics']:.2f}", "")
            console.print(table)
        if json is not None:
            write_json(json, reports)


def _physics(robot: Robot) -> Callable[[], None]:
    """Return one servo period of physics on a plant of its own, held where the robot rests."""
    plant = Plant(robot)
    steps = robot.period_ns // PHYSICS_STEP_NS
    return lambda: mujoco.mj_step(plant.model, plant.data, steps)
