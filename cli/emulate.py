"""`robotctl emulate`: serve a robot's emulated drives to other programs."""

from collections.abc import Callable, Sequence
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
from robotctl.sim.motors.orders import REGISTER_FORM, TROUBLE_FORM, give_orders
from robotctl.sim.motors.ports import open_ports
from robotctl.sim.motors.server import Pace, Port, Server, serve
from robotctl.sim.motors.shared_plant import SharedPlant

Lines = Sequence[tuple[Bench, Port, Server]]
"""What there is of each bus."""


def emulate(
    robot: Annotated[str, typer.Option(help="Robot whose drives to emulate, or the path of its profile.")] = "openarm",
    channel: Annotated[
        str,
        typer.Option(
            help="Where to serve: slcan (a new pseudo-terminal), socketcan:INTERFACE, or another; one for each bus."
        ),
    ] = "slcan",
    adapters: Annotated[int, typer.Option(min=1, max=16, help="slcan adapters to offer on each bus.")] = 1,
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
            ports = [stack.enter_context(closing(port)) for port in open_ports(channel, loaded, adapters)]
            # As they leave the factory, drives answer in classic CAN, which every host hears; CAN FD is a setting.
            for port in ports:
                if fd and not port.fd:
                    raise ConfigError(
                        f"no CAN FD passes on {port.name}", "drop --fd, or serve on an interface with mtu 72"
                    )
            start = clock.now_ns()
            plant = SharedPlant(loaded, start, fd, seed)
            give_orders(plant.benches, register or (), trouble or ())
            pace = Pace(clock, plant.advance, start)
            servers = [Server(bench, port, pace) for bench, port in zip(plant.benches, ports, strict=True)]
            for server in servers:
                server.on_status = _tell
            if log is not None:
                writer = _open_log(log)
                stack.callback(writer.stop)
                for bus, server in enumerate(servers):
                    server.on_frame = _writing(writer, f"can{bus}")
            lines = list(zip(plant.benches, ports, servers, strict=True))
            _announce(lines)
            _write(json, robot, lines)
            end = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
            interrupted = False
            try:
                serve(servers, pace, lambda: end is not None and clock.now_ns() >= end)
            except KeyboardInterrupt:
                interrupted = True
            _write(json, robot, lines)
    if interrupted:
        raise typer.Exit(Exit.INTERRUPTED)


def _open_log(path: Path) -> can.Listener:
    try:
        return can.Logger(path)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot log to {path}: {error}", "use a file that ends in .log, .asc, .blf or .csv"
        ) from None


def _writing(writer: can.Listener, channel: str) -> Callable[[can.Message], None]:
    def write(frame: can.Message) -> None:
        frame.channel = channel
        writer.on_message_received(frame)

    return write


def _tell(drive: EmulatedDrive, before: object, silent_s: float) -> None:
    change = f"{drive.told(before)} -> {drive.told(drive.status)}"
    print(f"{drive.name}: {change}, {1e3 * silent_s:.0f} ms after the last frame", flush=True)


def _announce(lines: Lines) -> None:
    console = Console()
    for bench, port, _ in lines:
        table = Table(title=f"emulated drives on {port.name}")
        for column in ("joint", "id", "reply id", "model", "answers in"):
            table.add_column(column)
        for drive in bench.drives:
            answers = "CAN FD" if drive.fd else "classic CAN"
            table.add_row(drive.name, f"0x{drive.id:02X}", f"0x{drive.reply_id:02X}", drive.model, answers)
        console.print(table)
    # On a line of its own and unbroken, for scripts.
    console.print(f"channel: {_channel(lines)}", soft_wrap=True, highlight=False)


def _channel(lines: Lines) -> str:
    """Return what a host opens."""
    return ",".join(port.name for _, port, _ in lines)


def _write(path: Path | None, robot: str, lines: Lines) -> None:
    if path is None:
        return
    content = {
        "robot": robot,
        "channel": _channel(lines),
        "fd": all(port.fd for _, port, _ in lines),
        "motors": [
            {
                "joint": drive.name,
                "bus": bus,
                "id": drive.id,
                "reply_id": drive.reply_id,
                "model": drive.model,
                "fd": drive.fd,
                "status": drive.status,
                "flash_cycles": drive.cycles,
            }
            for bus, (bench, _, _) in enumerate(lines)
            for drive in bench.drives
        ],
        "received": sum(server.received for _, _, server in lines),
        "answered": sum(server.answered for _, _, server in lines),
        "lost": sum(server.lost for _, _, server in lines),
        "garbage": sum(port.garbage for _, port, _ in lines),
    }
    fresh = path.with_name(path.name + ".part")
    # Replaced in one go, since others wait for this file to appear.
    write_json(fresh, content)
    fresh.replace(path)
