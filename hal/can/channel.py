"""Where the drives are: a channel's name, opened as a python-can bus.

`emulated` and whatever else other packages add come from the entry point group `robotctl.channels`, so that the HAL
imports no simulation. Nothing is sent by opening.
"""

import errno
import importlib
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import can

from robotctl.hal.can.kernel_queue import KernelQueue
from robotctl.hal.can.outbox import Outbox
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, ConfigError, RobotctlError
from robotctl.hal.profile import CanBus
from robotctl.hal.robot import Robot
from robotctl.hal.types import Truth

FORMS = "emulated, virtual:NAME, socketcan:INTERFACE, slcan:DEVICE, or INTERFACE:CHANNEL for any other of python-can's"

_CLOSE_TRIES = 3
SLCAN_SETTLE_S = 0.1
"""Wait after a serial port was opened. python-can waits 2 s, for adapters that reboot when opened; USB ones do not."""

# python-can logs what it raises as well, and without a handler of ours that would reach the terminal.
logging.getLogger("can").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class Channel:
    """An open bus, and what is known of it."""

    bus: can.BusABC
    fd: bool
    """Whether CAN FD frames pass."""
    truth: Callable[[], Truth] | None = None
    """The true state of the plant behind it, where that is known."""
    others: tuple["Channel", ...] = ()
    """The channels of the robot's other buses, where opening one opens them all."""
    simulated: bool = False
    """Whether its time is the clock's that it was opened with, and nothing arrives unless that clock moves."""
    outbox: Outbox | None = None
    """What is known of frames that have not left; None where nothing is."""

    def close(self) -> bool:
        """Shut the bus down, and return whether that went well; an interface that has vanished cannot be closed.

        A serial port refuses its last bytes while its queue is full, which passes.
        """
        for _ in range(_CLOSE_TRIES):
            try:
                self.bus.shutdown()
            except (can.CanError, OSError):
                continue
            return True
        return False


ChannelFactory = Callable[[Robot, Clock], Channel]
"""What an entry point of the group `robotctl.channels` must be."""


_OPEN_ERRORS = (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError, NameError)
"""NameError is what some of python-can's interfaces end in where the vendor's library is missing."""


def split_channels(name: str) -> list[str]:
    """Return the channels that a robot on several buses was given, with commas between them."""
    return name.split(",")


def channel_names(name: str, robot: Robot) -> list[str]:
    """Return what each bus of a robot is called: its own channel's name, or that of the one that opens them all.

    Raises:
        ConfigError: if there are not as many channels as buses, or the same one twice.
    """
    names, buses = split_channels(name), robot.profile.buses
    if name in _factories():
        return names * buses
    if len(names) != buses or len(set(names)) != buses:
        example = ",".join(f"socketcan:can{bus}" for bus in range(buses))
        raise ConfigError(
            f"robot {robot.profile.name!r} is on {buses} {'bus' if buses == 1 else 'buses'}, and --channel {name!r} "
            f"names {len(set(names))}",
            f"use --channel {example}" if buses > 1 else "name one channel",
        )
    return names


def is_shared(name: str) -> bool:
    """Return whether other processes reach the drives behind a channel, or behind one of several, too."""
    return any(bool(one.partition(":")[2]) and not _is_private(one) for one in split_channels(name))


def _is_private(name: str) -> bool:
    return name.partition(":")[0] in _factories().keys() | {"virtual"}


def _factories() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group="robotctl.channels")}


def may_be_real(name: str) -> bool:
    """Return whether there may be real drives behind a channel, or behind one of several.

    At a pseudo-terminal or a virtual interface there are none.
    """
    return any(_may_be_real(one) for one in split_channels(name))


def _may_be_real(name: str) -> bool:
    interface, _, where = name.partition(":")
    if interface == "slcan" and os.path.realpath(where).startswith("/dev/pts/"):
        return False
    if interface == "socketcan" and Path("/sys/devices/virtual/net", where).exists():
        return False
    return is_shared(name)


def prepare_channel(name: str) -> None:
    """Load now what `open_channel` would have to load first, so that it will open in milliseconds."""
    for one in split_channels(name):
        backend = can.interfaces.BACKENDS.get(one.partition(":")[0])
        if backend is not None:
            importlib.import_module(backend[0])


def open_channel(name: str, robot: Robot, clock: Clock) -> Channel:
    """Open a channel by name.

    Raises:
        ConfigError: if the name has no known form, or the robot has no CAN drives.
        BusError: if it cannot be opened.
    """
    return _open(name, robot, clock, SLCAN_SETTLE_S)


def open_channels(name: str, robot: Robot, clock: Clock) -> list[Channel]:
    """Open the channels of all buses of a robot; if one cannot be, none stays open. Raises as `open_channel` does."""
    opened: list[Channel] = []
    try:
        for one in split_channels(name):
            first = open_channel(one, robot, clock)
            opened += [first, *first.others]
    except RobotctlError:
        for channel in opened:
            channel.close()
        raise
    return opened


def reopen_channel(name: str, robot: Robot, clock: Clock) -> Channel:
    """Open a channel that was open until just now, so that nothing has to settle. Raises as `open_channel` does."""
    return _open(name, robot, clock, 0.0)


def _open(name: str, robot: Robot, clock: Clock, settle_s: float) -> Channel:
    wiring = robot.profile.can
    if wiring is None:
        raise ConfigError(
            f"robot {robot.profile.name!r} has no CAN drives", "use --backend sim, or a robot with drives"
        )
    interface, _, where = name.partition(":")
    factories = _factories()
    if interface in factories:
        if where:
            raise ConfigError(f"channel {interface!r} takes no {where!r}", f"use {interface}")
        factory: ChannelFactory = factories[interface].load()
        return factory(robot, clock)
    if not interface or not where:
        raise ConfigError(f"unknown channel {name!r}", f"use {FORMS}")
    if interface not in can.VALID_INTERFACES:
        raise ConfigError(
            f"unknown channel {name!r}: python-can has no interface {interface!r}",
            f"use {FORMS}: {', '.join(sorted(can.VALID_INTERFACES))}",
        )
    return open_wired(name, wiring, options(interface, wiring, settle_s))


def open_wired(name: str, wiring: CanBus, options: Mapping[str, Any]) -> Channel:
    """Open one of python-can's channels with options of the caller's, such as those of `options`.

    Raises:
        BusError: if it cannot be opened.
    """
    interface, _, where = name.partition(":")
    bus = open_bus(interface, where, options)
    outbox = KernelQueue(where, bus) if interface == "socketcan" else None
    return Channel(bus, fd=wiring.fd and bus.protocol is not can.CanProtocol.CAN_20, outbox=outbox)


def open_bus(interface: str, where: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open a python-can bus, ignoring python-can's own configuration files.

    Raises:
        BusError: with what can be done about it.
    """
    try:
        return can.Bus(channel=where, interface=interface, ignore_config=True, **options)
    except _OPEN_ERRORS as error:
        raise BusError(f"cannot open {interface}:{where}: {error}", _remedy(interface, where, error)) from error


def options(interface: str, wiring: CanBus, settle_s: float = SLCAN_SETTLE_S) -> dict[str, Any]:
    """Return what an interface of python-can has to be told of the wiring."""
    match interface:
        case "virtual":
            return {"protocol": can.CanProtocol.CAN_FD if wiring.fd else can.CanProtocol.CAN_20}
        case "socketcan" | "udp_multicast":
            return {"fd": wiring.fd}
        case "slcan":
            return {"bitrate": wiring.bitrate, "sleep_after_open": settle_s}
        case _:
            return {"bitrate": wiring.bitrate}


def _remedy(interface: str, where: str, error: Exception) -> str:
    number = _errno(error)
    if interface == "socketcan":
        if number == errno.EAFNOSUPPORT:
            return "this kernel has no CAN; load it with `modprobe can-raw`, or use an slcan adapter: slcan:DEVICE"
        if number in (errno.EPERM, errno.EACCES):
            return "opening a CAN socket was forbidden; run outside the sandbox, or allow raw CAN sockets"
        return (
            f"look for the interface with `ip link show type can`; bring it up with `ip link set {where} up type can "
            f"bitrate 1000000 dbitrate 5000000 fd on`, or for a virtual one `ip link add {where} type vcan`"
        )
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission for {where}; add yourself to the group that owns it (`ls -l {where}`), often dialout"
    if number == errno.EBUSY:
        return f"{where} is in use by another program; close that first"
    if interface == "slcan":
        return f"is the adapter plugged in? `ls {where} /dev/ttyACM* /dev/ttyUSB*` shows serial devices"
    if isinstance(error, ImportError | NameError | can.CanInterfaceNotImplementedError):
        return f"install the driver package that python-can needs for {interface!r}"
    return f"check that {where!r} is a channel of python-can's interface {interface!r}"


def _errno(error: BaseException | None) -> int | None:
    # python-can and pyserial wrap the system's error, each in its own way.
    while error is not None:
        number = getattr(error, "errno", None) or getattr(error, "error_code", None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return None
