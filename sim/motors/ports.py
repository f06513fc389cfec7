"""A channel's name, opened as a port for emulated drives to be served on."""

from contextlib import ExitStack, closing
from pathlib import Path

import can

from robotctl.hal.can.channel import open_bus, options, split_channels
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.sim.motors.server import BusPort, Port
from robotctl.sim.motors.terminal import SlcanPort

_FD_MTU = 72


def open_ports(channel: str, robot: Robot, adapters: int = 1) -> list[Port]:
    """Open a port for each bus of a robot: channels with commas between them, or slcan for all. Raises as `open_port`.

    If one cannot be opened, none stays open.
    """
    buses = robot.profile.buses
    names = [channel] * buses if channel == "slcan" else split_channels(channel)
    if len(names) != buses:
        raise ConfigError(
            f"robot {robot.profile.name!r} is on {buses} {'bus' if buses == 1 else 'buses'}, and --channel "
            f"{channel!r} names {len(names)}",
            "name one channel for each, with commas between them, or use slcan",
        )
    with ExitStack() as stack:
        ports = [stack.enter_context(closing(open_port(name, robot, adapters))) for name in names]
        stack.pop_all()
    return ports


def open_port(channel: str, robot: Robot, adapters: int = 1) -> Port:
    """Open a channel to serve drives on: slcan, or INTERFACE:CHANNEL of python-can.

    Of slcan adapters there may be several, side by side on one bus.

    Raises:
        ConfigError: if the name has no known form, or the robot has no CAN drives.
        BusError: if it cannot be opened.
    """
    wiring = robot.profile.can
    if wiring is None:
        raise ConfigError(f"robot {robot.profile.name!r} has no CAN drives to emulate", "use panda, openarm or xarm7")
    if channel == "slcan":
        return SlcanPort(adapters, wiring.bitrate)
    interface, _, where = channel.partition(":")
    if interface not in can.VALID_INTERFACES or not where:
        raise ConfigError(
            f"unknown channel {channel!r}",
            "use slcan for a new pseudo-terminal, socketcan:INTERFACE, virtual:NAME, or another INTERFACE:CHANNEL of "
            "python-can's",
        )
    bus = open_bus(interface, where, options(interface, wiring))
    fd = wiring.fd and bus.protocol is not can.CanProtocol.CAN_20
    if interface == "socketcan":
        # The socket takes CAN FD whether or not the interface does.
        fd = fd and _mtu(where) >= _FD_MTU
    return BusPort(channel, bus, fd)


def _mtu(interface: str) -> int:
    path = Path("/sys/class/net") / interface / "mtu"
    return int(path.read_text(encoding="ascii")) if path.is_file() else 0
