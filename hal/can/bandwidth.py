"""How long frames take on the wire, and whether a servo rate fits on a bus.

Every drive takes a command and gives a reply in every period.
"""

from collections.abc import Sequence

from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import CLASSIC_HZ, AnyDrive, CanBus, Cia402Drive

HIGHEST_LOAD = 0.9
"""What cyclic frames may take of a bus; the rest is for retransmissions, gripper and questions."""

_PDO_BITS = (125, 115, 135, 105)
"""Of RPDO1, RPDO2, TPDO1 and TPDO2 of a CiA 402 drive (7, 6, 8 and 5 bytes) at the worst of bit stuffing."""
_SYNC_BITS = 55


def frame_time_ns(fd: bool, bitrate: int, data_bitrate: int) -> float:
    """Return the time on the wire of one frame of 8 bytes, standard id, worst-case bit stuffing.

    Classic: 135 bits. FD: about 43 bits of arbitration and end at the nominal rate, 110 at the data rate (65 us at
    1M/5M).
    """
    return 43e9 / bitrate + 110e9 / data_bitrate if fd else 135e9 / bitrate


def cycle_s(drives: Sequence[AnyDrive], wiring: CanBus, fd: bool) -> float:
    """Return the time on the wire of one cycle of the drives on one bus, with the worst bit stuffing.

    CiA 402 drives speak classic CAN, whatever `fd`, and share one SYNC.
    """
    nodes = sum(isinstance(drive, Cia402Drive) for drive in drives)
    bits = nodes * sum(_PDO_BITS) + _SYNC_BITS if nodes else 0
    others = len(drives) - nodes
    return bits / wiring.bitrate + 2e-9 * others * frame_time_ns(fd, wiring.bitrate, wiring.data_bitrate)


def highest_hz(drives: Sequence[AnyDrive], wiring: CanBus, fd: bool, load: float = HIGHEST_LOAD) -> int:
    """Return the highest servo rate that loads the bus by no more than `load`; on classic CAN at most CLASSIC_HZ."""
    rate = int(load / cycle_s(drives, wiring, fd))
    return rate if fd else min(rate, CLASSIC_HZ)


def require_bandwidth(channel: str, drives: Sequence[AnyDrive], hz: int, wiring: CanBus, fd: bool) -> None:
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
    canopen = any(isinstance(drive, Cia402Drive) for drive in drives)
    ways = [f"--set servo_hz={highest}"] + ["CAN FD"] * (not fd and not canopen) + ["a second bus"] * (not canopen)
    raise ConfigError(
        f"{channel}: {len(drives)} drives at {hz} Hz do not fit on {kind} Mbit/s: a cycle takes {cycle * 1e3:.2f} ms "
        f"of the wire, a load of {cycle * hz:.0%}",
        ", or ".join(ways),
    )
