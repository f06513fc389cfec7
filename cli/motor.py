"""`robotctl motor`: look at drives one by one, and set what is set once. Nothing here enables or moves."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from robotctl.cli.confirm import confirm
from robotctl.cli.errors import Exit, readable_errors
from robotctl.cli.output import write_json
from robotctl.control.workbench import Workbench, open_workbench
from robotctl.hal.can.dump import DumpedMotor, read_dump, readable, write_dump
from robotctl.hal.can.flash_log import MANY, PROMISED, writes
from robotctl.hal.can.service import Difference, Motor
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot

motor_app = typer.Typer(help="Look at single drives, and set their ids, zeros and watchdogs.", no_args_is_help=True)

_Channel = Annotated[str, typer.Option(help="emulated, socketcan:can0, slcan:DEVICE.")]
_Robot = Annotated[str, typer.Option(help="Robot whose wiring is used, and whose joints have names.")]
_Motor = Annotated[str, typer.Argument(help="Its id (5 or 0x05), or its joint's name.", metavar="MOTOR")]
_Motors = Annotated[
    list[str] | None, typer.Argument(help="Ids, or joints' names; all that answer by default.", metavar="[MOTOR]...")
]
_Yes = Annotated[bool, typer.Option("--yes", help="Do not ask: for scripts.")]
_Json = Annotated[Path | None, typer.Option(help="Write what was found or done here.")]
_console = Console(highlight=False, soft_wrap=True)


@motor_app.command()
def info(motors: _Motors = None, channel: _Channel = "emulated", robot: _Robot = "panda", json: _Json = None) -> None:
    """Show everything that drives store and measure."""
    with _bench(channel, robot) as bench:
        report = []
        for motor in bench.motors(motors or []):
            found, serial, status = motor.read(), motor.serial(), motor.status()
            times = writes(motor.protocol, serial)
            title = f"{bench.name(motor.id)} (0x{motor.id:02X}), serial 0x{serial:08X}, {status}"
            _print_columns(f"{title}, flash written {times} times from here", found)
            entry = {"id": motor.id, "name": bench.name(motor.id), "serial": serial, "status": status}
            report.append({**entry, "flash_writes": times, "parameters": found})
        _write(json, report)
    if not report:
        raise typer.Exit(Exit.NO_HARDWARE)


@motor_app.command()
def set_id(
    motor: _Motor,
    new_id: Annotated[str, typer.Argument(help="The id that it shall have.")],
    reply_id: Annotated[str, typer.Option(help="The id that it shall answer with; by default 0x10 more.")] = "",
    channel: _Channel = "emulated",
    robot: _Robot = "panda",
    yes: _Yes = False,
    json: _Json = None,
) -> None:
    """Give a drive another id. It must be the only one with its present id, and the new one must be free."""
    with _bench(channel, robot) as bench:
        drive, new = bench.one(motor), _number(new_id)
        reply = _number(reply_id) if reply_id else new + 0x10
        old = drive.id
        confirm(_console, f"0x{old:02X} becomes 0x{new:02X}, with replies on 0x{reply:02X}", f"0x{new:02X}", yes)
        drive.set_id(new, reply)
        _report_all(bench, json, [(drive, {"old_id": old, "id": new, "reply_id": reply})])


@motor_app.command()
def set_zero(
    motor: _Motor, channel: _Channel = "emulated", robot: _Robot = "panda", yes: _Yes = False, json: _Json = None
) -> None:
    """Make the angle where a joint stands now the zero of its drive."""
    with _bench(channel, robot) as bench:
        drive = bench.one(motor)
        who = f"{bench.name(drive.id)} (0x{drive.id:02X})"
        confirm(_console, f"{who}: where it stands now becomes its zero", f"0x{drive.id:02X}", yes)
        angle = drive.set_zero()
        _report_all(bench, json, [(drive, {"id": drive.id, "position": angle})])


@motor_app.command()
def set_watchdog(
    motor: Annotated[str, typer.Argument(help="An id, a joint's name, or `all` that answer.")],
    milliseconds: Annotated[float, typer.Argument(help="Silence after which it goes off by itself.")],
    channel: _Channel = "emulated",
    robot: _Robot = "panda",
    yes: _Yes = False,
    json: _Json = None,
) -> None:
    """Have drives go off by themselves when nobody has spoken to them for so long."""
    with _bench(channel, robot) as bench:
        drives = bench.motors([motor])
        listed = ", ".join(f"0x{drive.id:02X}" for drive in drives)
        confirm(_console, f"{listed}: off after {milliseconds:g} ms of silence", f"{milliseconds:g}", yes)
        for drive in drives:
            drive.set_watchdog(1e-3 * milliseconds)
        _report_all(bench, json, [(drive, {"id": drive.id, "timeout_s": 1e-3 * milliseconds}) for drive in drives])
    if not drives:
        raise typer.Exit(Exit.NO_HARDWARE)


@motor_app.command()
def dump(
    file: Annotated[Path, typer.Argument(help="YAML file to write; it must not exist.")],
    motors: _Motors = None,
    channel: _Channel = "emulated",
    robot: _Robot = "panda",
    json: _Json = None,
) -> None:
    """Keep everything that drives store in a file."""
    with _bench(channel, robot) as bench:
        taken = bench.dump(bench.motors(motors or []))
        if taken.motors:
            write_dump(file, taken)
            _console.print(f"{len(taken.motors)} drives in {file}", markup=False)
        _write(json, taken.model_dump())
    if not taken.motors:
        raise typer.Exit(Exit.NO_HARDWARE)


@motor_app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="What `motor dump` wrote.")],
    motors: _Motors = None,
    channel: _Channel = "emulated",
    robot: _Robot = "panda",
    yes: _Yes = False,
    json: _Json = None,
) -> None:
    """Write what a file says back to drives, where it differs. Ids and bit rate stay as they are."""
    with _bench(channel, robot) as bench:
        kept, done = read_dump(file), []
        for drive in bench.motors(motors or []):
            wanted = kept.motor(drive.id)
            different = [d for d in drive.differences(wanted.parameters, drive.read()) if d.name in drive.restorable]
            if different:
                other = "" if drive.serial() == wanted.serial else ", another motor than in the file"
                _print_differences(f"{bench.name(drive.id)} (0x{drive.id:02X}){other}", different, "file", "drive")
                confirm(_console, f"{len(different)} values from {file}", f"0x{drive.id:02X}", yes)
                drive.write({d.name: d.wanted for d in different if d.wanted is not None})
                done.append((drive, {"id": drive.id, "written": [d._asdict() for d in different]}))
        if not done:
            _console.print("nothing to restore: they are as the file says")
        _report_all(bench, json, done)


@motor_app.command()
def diff(
    file: Annotated[Path | None, typer.Option(help="Compare with a dump instead of the profile.")] = None,
    motors: _Motors = None,
    channel: _Channel = "emulated",
    robot: _Robot = "panda",
    json: _Json = None,
) -> None:
    """Compare drives with the profile, or with a dump. Exit status 4 if they differ."""
    with _bench(channel, robot) as bench:
        kept = read_dump(file) if file is not None else None
        report: list[dict[str, Any]] = []
        for drive in bench.motors(motors or []):
            who = f"{bench.name(drive.id)} (0x{drive.id:02X})"
            if kept is None:
                note, different = "", bench.departures(drive)
            else:
                wanted = kept.motor(drive.id)
                note = _stranger(drive, wanted, kept.owner(drive.serial()))
                different = drive.differences(wanted.parameters, drive.read())
            if note:
                _console.print(f"{who}: {note}", style="yellow", markup=False)
            if different:
                _print_differences(who, different, "profile" if kept is None else "file", "drive")
            report.append({"id": drive.id, "note": note, "differences": [d._asdict() for d in different]})
        _write(json, report)
    if not report or any(entry["note"] or entry["differences"] for entry in report):
        raise typer.Exit(Exit.NO_HARDWARE)
    _console.print(f"{len(report)} drives are as the {'profile' if kept is None else 'file'} says")


@contextmanager
def _bench(channel: str, robot: str) -> Iterator[Workbench]:
    with readable_errors(), open_workbench(channel, load_robot(robot), MonotonicClock()) as bench:
        yield bench


def _number(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        raise ConfigError(f"{text!r} is no id", "for example 5 or 0x05") from None


def _stranger(drive: Motor, wanted: DumpedMotor, owner: DumpedMotor | None) -> str:
    """Return in words if this is another motor than the one that the file knows by this id."""
    serial = drive.serial()
    if serial == wanted.serial:
        return ""
    what = f"another motor than in the file: serial 0x{serial:08X}, not 0x{wanted.serial:08X}"
    return f"{what}; the file knows it as 0x{owner.id:02X} ({owner.name}): swapped?" if owner else what


def _report_all(bench: Workbench, json: Path | None, done: list[tuple[Motor, dict[str, Any]]]) -> None:
    """Count the writes, and say what was done."""
    report = []
    for drive, entry in done:
        times = bench.count(drive)
        _console.print(f"[green]stored[/] 0x{drive.id:02X}: read back; flash written {times} times from this machine")
        if times >= MANY:
            _console.print(f"[yellow]that is much of the {PROMISED} times that its flash is promised to last[/]")
        report.append({**entry, "flash_writes": times})
    _write(json, report)


def _write(json: Path | None, report: Any) -> None:
    if json is not None:
        write_json(json, report)


def _print_columns(title: str, values: dict[str, float]) -> None:
    _console.print(title, style="bold", markup=False)
    names = list(values)
    rows = -(-len(names) // 4)
    for row in range(rows):
        cells = [f"{name:>9} {readable(values[name])!s:<12}" for name in names[row::rows]]
        _console.print("".join(cells).rstrip(), markup=False)


def _print_differences(title: str, different: list[Difference], theirs: str, ours: str) -> None:
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("parameter", theirs, ours):
        table.add_column(heading)
    for name, wanted, found in different:
        table.add_row(name, *("-" if value is None else str(readable(value)) for value in (wanted, found)))
    _console.print(table)
