"""`robotctl emulate`: serve a robot's emulated drives to other programs."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import can
import typer
from rich.console import Console
from rich.table import Table

from robotctl.cli.errors import Exit, hear_interrupts, readable_errors
from robotctl.cli.output import write_json
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.drive import EmulatedDrive
from robotctl.sim.motors.orders import REGISTER_FORM, TROUBLE_FORM, order_register, order_trouble
from robotctl.sim.motors.ports import open_port
from robotctl.sim.motors.server import Port, Server


def emulate(
    robot: Annotated[str, typer.Option(help="Robot whose drives to emulate, or the path of its profile.")] = "openarm",
    channel: Annotated[
        str,
        typer.Option(
            help="Where to serve: slcan (a new pseudo-terminal), socketcan:INTERFACE, or another of python-can's."
        ),
    ] = "slcan",
    adapters: Annotated[int, typer.Option(min=1, max=16, help="slcan adapters to offer, all on one bus.")] = 1,
    fd: Annotated[
        bool,
        typer.Option(
            "--fd", help="Set the drives to CAN FD at 5 Mbit/s, where they answer in CAN FD whatever they hear."
        ),
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Stop after this time instead of at Ctrl-C.")] = None,
    trouble: Annotated[list[str] | None, typer.Option(help=f"What goes wrong; repeatable. {TROUBLE_FORM}.")] = None,
    register: Annotated[list[str] | None, typer.Option(help=f"Preset; repeatable. {REGISTER_FORM}.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of noise and trouble.")] = 0,
    log: Annotated[
        Path | None, typer.Option(help="Write every frame here; the ending says how, as candump does in .log.")
    ] = None,
    json: Annotated[
        Path | None, typer.Option(help="Write channel and motors at the start, counters at the end.")
    ] = None,
) -> None:
    """Serve emulated drives that speak the wire byte for byte, in real time, until Ctrl-C (exit status 130)."""
    hear_interrupts()
    with readable_errors():
        clock = MonotonicClock()
        loaded = load_robot(robot)
        with ExitStack() as stack:
            port = stack.enter_context(closing(open_port(channel, loaded, adapters)))
            # As they leave the factory, drives answer in classic CAN, which every host hears; CAN FD is a setting.
            if fd and not port.fd:
                raise ConfigError(f"no CAN FD passes on {port.name}", "drop --fd, or serve on an interface with mtu 72")
            bench = Bench(loaded, clock.now_ns(), fd=fd, seed=seed)
            for order in register or ():
                order_register(bench, order)
            for order in trouble or ():
                order_trouble(bench, order)
            server = Server(bench, port, clock)
            server.on_status = _tell
            if log is not None:
                writer = _open_log(log)
                stack.callback(writer.stop)
                server.on_frame = writer.on_message_received
            _announce(bench, port)
            _write(json, robot, bench, port, server)
            end = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
            interrupted = False
            try:
                server.serve(lambda: end is not None and clock.now_ns() >= end)
            except KeyboardInterrupt:
                interrupted = True
            _write(json, robot, bench, port, server)
    if interrupted:
        raise typer.Exit(Exit.INTERRUPTED)


def _open_log(path: Path) -> can.Listener:
    try:
        return can.Logger(path)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot log to {path}: {error}", "use a file that ends in .log, .asc, .blf or .csv"
        ) from None


def _tell(drive: EmulatedDrive, before: object, silent_s: float) -> None:
    change = f"{drive.told(before)} -> {drive.told(drive.status)}"
    print(f"{drive.name}: {change}, {1e3 * silent_s:.0f} ms after the last frame", flush=True)


def _announce(bench: Bench, port: Port) -> None:
    table = Table(title=f"emulated drives on {port.name}")
    for column in ("joint", "id", "reply id", "model", "answers in"):
        table.add_column(column)
    for drive in bench.drives:
        answers = "CAN FD" if drive.fd else "classic CAN"
        table.add_row(drive.name, f"0x{drive.id:02X}", f"0x{drive.reply_id:02X}", drive.model, answers)
    console = Console()
    console.print(table)
    # On a line of its own and unbroken, for scripts.
    console.print(f"channel: {port.name}", soft_wrap=True, highlight=False)


def _write(path: Path | None, robot: str, bench: Bench, port: Port, server: Server) -> None:
    if path is None:
        return
    content = {
        "robot": robot,
        "channel": port.name,
        "fd": port.fd,
        "motors": [
            {
                "joint": drive.name,
                "id": drive.id,
                "reply_id": drive.reply_id,
                "model": drive.model,
                "fd": drive.fd,
                "status": drive.status,
                "flash_cycles": drive.cycles,
            }
            for drive in bench.drives
        ],
        "received": server.received,
        "answered": server.answered,
        "lost": server.lost,
        "garbage": port.garbage,
    }
    fresh = path.with_name(path.name + ".part")
    # Replaced in one go, since others wait for this file to appear.
    write_json(fresh, content)
    fresh.replace(path)
