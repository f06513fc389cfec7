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
from robotctl.cli.findings import print_findings
from robotctl.cli.output import write_json
from robotctl.control.registry import claimed
from robotctl.hal.can.cia402.scan import FoundNode
from robotctl.hal.can.damiao.registers import ControlMode
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.scan import LAST_ID, Scan, sweep
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.host import Level
from robotctl.hal.robot import load_robot


def scan(
    channel: Annotated[str, typer.Option(help="emulated, virtual:NAME, socketcan:can0, slcan:DEVICE.")] = "emulated",
    robot: Annotated[str, typer.Option(help="Robot whose wiring (CAN FD, bit rates) is tried first.")] = "panda",
    last: Annotated[int, typer.Option(min=1, max=0x7F, help="Ask the ids 1 to this.")] = LAST_ID,
    thorough: Annotated[
        bool, typer.Option("--thorough", help="Try every bit rate, even if somebody answers. Not on a bus in use.")
    ] = False,
    json: Annotated[Path | None, typer.Option(help="Write what was found here.")] = None,
) -> None:
    """Find the drives on a CAN bus, and say why nobody answers. Only reads; exit status 4 if nobody does."""
    console = Console(highlight=False)
    with readable_errors():
        model = load_robot(robot)
        with claimed(channel):
            found = sweep(channel, model, MonotonicClock(), last, thorough=thorough)
        for attempt in found.attempts:
            if attempt.motors:
                console.print(_table(attempt.motors, f"drives on {channel}, {attempt.way}"))
        if found.nodes:
            console.print(_node_table(found.nodes, f"CANopen nodes on {channel}"))
        print_findings(console, [finding for finding in found.findings if _is_news(found, finding.level)])
        if json is not None:
            write_json(json, _report(found, channel))
    if not found.motors and not found.nodes:
        raise typer.Exit(Exit.NO_HARDWARE)


def _is_news(found: Scan, level: Level) -> bool:
    """Return whether a finding is worth a line: what a channel cannot show matters only where something is wrong."""
    return level is not Level.OK or any(finding.level is not Level.OK for finding in found.findings)


def _table(motors: tuple[FoundMotor, ...], title: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=0)
    for heading in ("id", "reply", "motor", "sw", "mode", "watchdog\nms", "angle\nrad", "temp.\n°C", "status"):
        table.add_column(heading, overflow="fold")
    for motor in motors:
        table.add_row(*_row(motor))
    return table


def _node_table(nodes: tuple[FoundNode, ...], title: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=0)
    for heading in ("node", "profile", "vendor", "product", "watchdog\nms", "status"):
        table.add_column(heading, overflow="fold")
    for node in nodes:
        watchdog = f"{node.watchdog_s * 1e3:g}" if node.watchdog_s else "[bold red]off[/]"
        table.add_row(
            str(node.id), str(node.profile), f"0x{node.vendor:X}", f"0x{node.product:X}", watchdog, node.status
        )
    return table


def _report(found: Scan, channel: str) -> dict[str, Any]:
    """Return a scan as JSON-ready data. Units: rad, s, V, degrees Celsius, bit/s; unknown values are null."""
    return {
        "channel": channel,
        "motors": [_entry(motor) for motor in found.motors],
        "nodes": [dataclasses.asdict(node) for node in found.nodes],
        "findings": [finding._asdict() for finding in found.findings],
        "attempts": [
            {**attempt.way._asdict(), "motors": [_entry(motor) for motor in attempt.motors], "errors": attempt.errors}
            for attempt in found.attempts
        ],
        "statistics": found.statistics,
    }


def _entry(motor: FoundMotor) -> dict[str, Any]:
    entry = dataclasses.asdict(motor)
    entry["identity"] = motor.identity and {**motor.identity._asdict(), "ranges": motor.identity.ranges._asdict()}
    entry["models"] = list(motor.models)
    entry["position"] = None if math.isnan(motor.position) else motor.position
    return entry


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
