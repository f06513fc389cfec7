"""`robotctl stop`: emergency stop for every running arm of this user, from any terminal."""

import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.control import registry

_TIMEOUT_S = 5.0


def stop(
    robot: Annotated[str, typer.Option(help="Stop only arms of this name.")] = "",
    json: Annotated[Path | None, typer.Option(help="Write what was stopped here.")] = None,
) -> None:
    """Emergency stop: brake, then drives off. Exit status 4 if nothing runs or something does not stop."""
    console = Console(highlight=False, soft_wrap=True)
    targets = [entry for entry in registry.running() if robot in ("", entry.robot)]
    for entry in targets:
        with suppress(ProcessLookupError):  # one that has just ended must not keep the others from being stopped
            os.kill(entry.pid, signal.SIGUSR1)
    deadline = time.monotonic() + _TIMEOUT_S
    waiting = list(targets)
    while waiting and time.monotonic() < deadline:
        waiting = [entry for entry in waiting if registry.start_time(entry.pid) == entry.started]
        time.sleep(0.02)
    for entry in targets:
        done = entry not in waiting
        mark = "[green]stopped[/]" if done else "[bold red]still running[/]"
        console.print(f"{mark} {entry.robot} on {entry.backend} {entry.channel} (pid {entry.pid})")
    with readable_errors():
        if json is not None:
            stopped = [{"robot": e.robot, "pid": e.pid, "stopped": e not in waiting} for e in targets]
            write_json(json, stopped)
    if not targets:
        console.print("nothing is running")
    if waiting or not targets:
        if waiting:
            console.print("use the emergency stop in hardware", style="bold red")
        raise typer.Exit(Exit.NO_HARDWARE)
