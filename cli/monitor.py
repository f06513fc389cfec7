"""`robotctl monitor`: listen to a bus. Sends nothing."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from robotctl.cli.errors import Exit, hear_interrupts, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.can.monitor import Heard, Monitor, listen, open_listening, words_of
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.robot import load_robot


def monitor(
    channel: Annotated[str, typer.Option(help="socketcan:can0, slcan:DEVICE, virtual:NAME.")],
    robot: Annotated[str, typer.Option(help="Robot whose drives give the ids their meaning.")] = "panda",
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after this time instead of at Ctrl-C.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write what was heard here.")] = None,
) -> None:
    """Listen only: who speaks on a bus, how often, what it means, and when it last changed."""
    hear_interrupts()
    console = Console(highlight=False)
    with readable_errors():
        model, clock = load_robot(robot), MonotonicClock()
        opened = open_listening(channel, model)
        heard = Monitor(words_of(model), clock.now_ns())
        until = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
        interrupted = False
        try:
            if console.is_terminal:
                with Live(console=console, auto_refresh=False, screen=False) as live:
                    listen(
                        opened, heard, clock, until, lambda: live.update(_table(heard, clock.now_ns()), refresh=True)
                    )
            else:
                listen(opened, heard, clock, until, lambda: _lines(heard, clock.now_ns()))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            opened.close()
        if json is not None:
            write_json(json, _report(heard, channel, clock.now_ns()))
    if interrupted:
        raise typer.Exit(Exit.INTERRUPTED)


def _table(heard: Monitor, now_ns: int) -> Table:
    errors = f", {heard.error_frames} error frames" if heard.error_frames else ""
    table = Table(box=box.SIMPLE_HEAD, caption=f"{heard.frames} frames{errors}; listening only", expand=True)
    for heading, justify in (("id", "left"), ("1/s", "right"), ("changed", "right"), ("", "left")):
        table.add_column(heading, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    for row in heard.rows:
        table.add_row(_id(row), f"{row.rate:.0f}", f"{_age(row, now_ns):.1f} s", escape(_words(row)))
    return table


def _lines(heard: Monitor, now_ns: int) -> None:
    for row in heard.rows:
        print(f"{_id(row)}  {row.rate:.0f}/s  changed {_age(row, now_ns):.1f} s ago  {_words(row)}", flush=True)
    if heard.error_frames:
        kinds = ", ".join(f"{count} x {kind}" for kind, count in heard.errors.kinds.items())
        print(f"{heard.error_frames} error frames: {kinds}", flush=True)


def _report(heard: Monitor, channel: str, now_ns: int) -> dict[str, Any]:
    return {
        "channel": channel,
        "frames": heard.frames,
        "error_frames": heard.error_frames,
        "errors": dict(heard.errors.kinds),
        "ids": [
            {
                "id": row.arbitration_id,
                "extended": row.extended,
                "fd": row.fd,
                "frames": row.frames,
                "rate_hz": row.rate,
                "data": row.data.hex(),
                "meaning": row.meaning,
                "unchanged_s": _age(row, now_ns),
            }
            for row in heard.rows
        ],
    }


def _id(row: Heard) -> str:
    return f"{row.arbitration_id:08X}" if row.extended else f"{row.arbitration_id:03X}"


def _age(row: Heard, now_ns: int) -> float:
    return 1e-9 * (now_ns - row.changed_ns)


def _words(row: Heard) -> str:
    return row.meaning if row.meaning != "?" else f"? {row.data.hex(' ')}"
