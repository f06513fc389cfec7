"""`robotctl scan`: who is on the bus. Enables, clears and writes nothing."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.can.channel import open_channel
from robotctl.hal.can.damiao.registers import ControlMode
from robotctl.hal.can.scan import LAST_ID, FoundMotor, Scan
from robotctl.hal.can.scan import scan as scan_channel
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.robot import load_robot


def scan(
    channel: Annotated[str, typer.Option(help="emulated, virtual:NAME, socketcan:can0, slcan:DEVICE.")] = "emulated",
    robot: Annotated[str, typer.Option(help="Robot whose wiring (CAN FD, bit rates) is used.")] = "panda",
    last: Annotated[int, typer.Option(min=1, max=0x7F, help="Ask the ids 1 to this.")] = LAST_ID,
    json: Annotated[Path | None, typer.Option(help="Write what was found here.")] = None,
) -> None:
    """Find the drives on a CAN bus. Only reads; exit status 4 if nobody answers."""
    console = Console(highlight=False)
    with readable_errors():
        clock = MonotonicClock()
        opened = open_channel(channel, load_robot(robot), clock)
        try:
            found = scan_channel(opened, clock, last)
        finally:
            opened.bus.shutdown()
        if found.motors:
            console.print(motor_table(found, channel))
        for hint in found.hints:
            console.print(f"- {hint}", markup=False)
        if json is not None:
            write_json(json, scan_report(found, channel))
    if not found.motors:
        raise typer.Exit(Exit.NO_HARDWARE)


def motor_table(found: Scan, channel: str) -> Table:
    """Return what a scan found, one row per motor."""
    table = Table(title=f"drives on {channel}", box=box.SIMPLE_HEAD, padding=0)
    for heading in ("id", "reply", "motor", "sw", "mode", "watchdog\nms", "angle\nrad", "temp.\n°C", "status"):
        table.add_column(heading, overflow="fold")
    for motor in found.motors:
        table.add_row(*_row(motor))
    return table


def scan_report(found: Scan, channel: str) -> dict[str, Any]:
    """Return a scan as JSON-ready data. Units: rad, s, degrees Celsius, bit/s; unknown values are null."""
    motors = []
    for motor in found.motors:
        entry = dataclasses.asdict(motor)
        entry["identity"] = motor.identity and {**motor.identity._asdict(), "ranges": motor.identity.ranges._asdict()}
        entry["models"] = list(motor.models)
        entry["position"] = None if math.isnan(motor.position) else motor.position
        motors.append(entry)
    return {"channel": channel, "motors": motors, "hints": list(found.hints), "statistics": found.statistics}


def _row(motor: FoundMotor) -> tuple[str, ...]:
    replies = ", ".join(f"0x{reply:02X}" for reply in motor.reply_ids)
    identity = motor.identity
    if identity is None:
        return (f"0x{motor.id:02X}", replies, "?", "", "", "", "", "", "fell silent")
    known = identity.mode in list(ControlMode)
    return (
        f"0x{motor.id:02X}",
        replies,
        " or ".join(motor.models) or "unknown",
        str(identity.software),
        ControlMode(identity.mode).name if known else f"? {identity.mode}",
        f"{identity.timeout_s * 1e3:g}" if identity.timeout_s else "[bold red]off[/]",
        f"{motor.position:.3f}",
        f"{motor.mosfet_temperature}, {motor.rotor_temperature}",
        motor.status,
    )
