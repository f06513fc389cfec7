"""Whether a servo rate fits on a bus: every drive takes a command and gives a reply in every period."""

from robotctl.hal.can.transport import frame_time_ns
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import CLASSIC_HZ, CanBus

HIGHEST_LOAD = 0.9
"""What cyclic frames may take of a bus; the rest is for retransmissions, gripper and questions."""


def cycle_s(drives: int, wiring: CanBus, fd: bool) -> float:
    """Return the time on the wire of one cycle of some drives on one bus, with the worst bit stuffing."""
    return 2e-9 * drives * frame_time_ns(fd, wiring.bitrate, wiring.data_bitrate)


def highest_hz(drives: int, wiring: CanBus, fd: bool, load: float = HIGHEST_LOAD) -> int:
    """Return the highest servo rate that loads the bus by no more than `load`; on classic CAN at most CLASSIC_HZ."""
    rate = int(load / cycle_s(drives, wiring, fd))
    return rate if fd else min(rate, CLASSIC_HZ)


def require_bandwidth(channel: str, drives: int, hz: int, wiring: CanBus, fd: bool) -> None:
    """Refuse a servo rate that the bus cannot carry.

    Raises:
        ConfigError: with the highest one that it can.
    """
    highest = highest_hz(drives, wiring, fd)
    if hz <= highest:
        return
    cycle = cycle_s(drives, wiring, fd)
    nominal, data = wiring.bitrate / 1e6, wiring.data_bitrate / 1e6
    kind = f"CAN FD at {nominal:g}/{data:g}" if fd else f"classic CAN at {nominal:g}"
    raise ConfigError(
        f"{channel}: {drives} drives at {hz} Hz do not fit on {kind} Mbit/s: a cycle takes {cycle * 1e3:.2f} ms of the "
        f"wire, a load of {cycle * hz:.0%}",
        f"--set servo_hz={highest}" + ("" if fd else ", or CAN FD") + ", or a second bus",
    )
