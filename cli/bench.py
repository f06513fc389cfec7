"""`robotctl bench`: what things cost, as ratios measured in one run."""

import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Annotated

import mujoco
import typer
from rich.console import Console
from rich.table import Table

from robotctl.cli.bench_bus import bus
from robotctl.cli.bench_endurance import endurance
from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.control.benchmark import bench_tick
from robotctl.hal.robot import Robot, load_robot, robot_names
from robotctl.sim.plant import PHYSICS_STEP_NS, Plant
from robotctl.trials.cost import MODES, POLICIES, bench_safety
from robotctl.trials.soak import cases, soak

bench_app = typer.Typer(help="Measure what things cost.", no_args_is_help=True)
bench_app.command()(bus)
bench_app.command()(endurance)


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


@bench_app.command()
def safety(
    robot: Annotated[str, typer.Option(help="Robot to measure.")] = "panda",
    ticks: Annotated[int, typer.Option(min=1000, help="Servo periods of each measurement.")] = 10_000,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Time every call of the shaper and of the guard, on both backends, under hostile policies."""
    table = Table(title=f"{robot}, microseconds")
    for column in ("backend", "mode", "policy", "shaper p50", "p99", "guard p50", "p99"):
        table.add_column(column, justify="right" if "p" in column[-3:] else "left")
    with readable_errors():
        model, reports = load_robot(robot), []
        for backend, mode, policy in product(["sim", "can"] if model.profile.can else ["sim"], MODES, POLICIES):
            report = bench_safety(model, backend, mode, policy, ticks)
            reports.append(report)
            costs = [report[layer][share] for layer in ("shaper", "guard") for share in ("p50", "p99")]
            table.add_row(backend, mode, policy, *(f"{cost:.1f}" for cost in costs))
        Console(highlight=False).print(table)
        if json is not None:
            write_json(json, {"robot": robot, "ticks": ticks, "measurements": reports})


@bench_app.command("soak")
def soak_(
    ticks: Annotated[
        int, typer.Option(min=1000, help="Servo ticks, shared by all robots, modes and policies.")
    ] = 10_000_000,
    robot: Annotated[list[str] | None, typer.Option(help="Robots; by default all that are shipped.")] = None,
    backend: Annotated[str, typer.Option(help="sim, or can for emulated drives.")] = "sim",
    jobs: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the results here.")] = None,
) -> None:
    """Let hostile policies work in lockstep, and count what breaks an invariant. Status 3 if anything does."""
    console = Console(highlight=False, soft_wrap=True)
    with readable_errors():
        names = robot or robot_names()
        for name in names:
            load_robot(name)
        began, results = time.monotonic(), []
        todo = list(cases(names, ticks, backend, seed))
        for done, result in enumerate(soak(todo, jobs), 1):
            results.append(result)
            found = sum(result["violations"].values()) + result["guard_trips"] + bool(result["ended"])
            mark = "[red]found[/]" if found else "[green]none [/]"
            worst = "  ".join(f"{key} {1e3 * value:+.1f}" for key, value in result["worst"].items())
            what = f"{result['robot']:8s} {result['mode']:8s} {result['policy']:9s} {result['ticks']:8d} ticks"
            console.print(
                f"{done:3d}/{len(todo)}  {mark}  {what}  {worst}  stops {result['trips'] or 'none'}"
                + (f", freed {result['freed']} times" if result["freed"] else "")
            )
            if result["ended"]:
                console.print(f"    ended: {result['ended_by']}", markup=False)
        total = sum(result["ticks"] for result in results)
        violations = sum(sum(result["violations"].values()) for result in results)
        guard = sum(result["guard_trips"] for result in results)
        ended = sum(bool(result["ended"]) for result in results)
        seconds = time.monotonic() - began
        console.print(
            f"{total} ticks in {seconds:.0f} s: {violations} violations, {guard} guard trips, {ended} ended early"
        )
        if json is not None:
            summary = {"ticks": total, "seconds": round(seconds), "violations": violations, "guard_trips": guard}
            write_json(json, {**summary, "ended_early": ended, "cases": results})
    if violations or guard or ended:
        raise typer.Exit(Exit.STOPPED_BY_SAFETY)


def _physics(robot: Robot) -> Callable[[], None]:
    """Return one servo period of physics on a plant of its own, held where the robot rests."""
    plant = Plant(robot)
    steps = robot.period_ns // PHYSICS_STEP_NS
    return lambda: mujoco.mj_step(plant.model, plant.data, steps)
