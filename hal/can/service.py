"""A drive at the service desk: what it stores is read, written and kept, one drive at a time. Never for motion.

Each wire protocol brings a `Motor` of its own; `MOTORS` says which.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import NamedTuple

from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import DamiaoDrive
from robotctl.hal.robot import Robot

Parameters = dict[str, float]
"""What a drive stores, by the protocol's own names, in the order of its list; integers are whole floats."""


class Difference(NamedTuple):
    """A parameter that is not as it should be."""

    name: str
    wanted: float | None
    """None where nothing is said of it."""
    found: float | None
    """None where the drive does not have it."""


class Motor(ABC):
    """One drive. Writing is refused while it is enabled, or if a second one answers to its id.

    Raises:
        DriveError: from every method, if the drive does not answer, refuses, or does not keep what was written.
        BusError: if the bus is gone.
    """

    protocol: str
    restorable: frozenset[str]
    """Parameters that `write` takes: not those that would cut the connection."""
    id: int
    flash_writes: int
    """Write cycles asked for through this object, and not counted yet."""

    @abstractmethod
    def serial(self) -> int:
        """Return its serial number."""

    @abstractmethod
    def status(self) -> str:
        """Return how it is, in the protocol's word: DISABLED, ENABLED or a fault."""

    @abstractmethod
    def read(self) -> Parameters:
        """Return everything that it stores or measures. Parameters that its firmware lacks are left out."""

    @abstractmethod
    def write(self, parameters: Mapping[str, float]) -> None:
        """Write parameters, read them back, and store them in flash: one write cycle.

        Raises:
            ConfigError: before anything is written, if one cannot be written or has no such value.
        """

    @abstractmethod
    def set_id(self, new_id: int, reply_id: int) -> None:
        """Change both ids, and store them; refused if somebody answers to the new one already."""

    @abstractmethod
    def set_zero(self) -> float:
        """Make the present angle zero, and store it; return the angle measured afterwards, rad of the motor."""

    @abstractmethod
    def set_watchdog(self, seconds: float) -> None:
        """Have it go off by itself after so long without a frame, and store that.

        Raises:
            ConfigError: if it takes no such time. Zero, which would switch the watchdog off, is refused.
        """

    @abstractmethod
    def differences(self, wanted: Mapping[str, float], found: Mapping[str, float]) -> list[Difference]:
        """Compare settings, as exactly as the drive stores them; what it measures, or only it can know, is left out."""

    @abstractmethod
    def departures(self, robot: Robot, drive: DamiaoDrive, mode: int, found: Mapping[str, float]) -> list[Difference]:
        """Compare with what a robot's profile says of this drive; `mode` is the control mode that it needs."""


MotorFactory = Callable[[Transport, Clock, int, str], Motor]
"""Takes transport, clock, id and the joint's name, and sends nothing."""


def make_motor(protocol: str, transport: Transport, clock: Clock, motor_id: int, name: str) -> Motor:
    """Return a drive of the named protocol. Sends nothing.

    Raises:
        ConfigError: if its drives are set up with other tools.
    """
    # Imported here, since the protocols themselves are written against this module.
    from robotctl.hal.can.damiao.desk import DamiaoMotor

    makers: dict[str, MotorFactory] = {"damiao": DamiaoMotor}
    if protocol not in makers:
        raise ConfigError(
            f"drives of the protocol {protocol!r} are not set up one by one here",
            "use the vendor's tool; scan reads them",
        )
    return makers[protocol](transport, clock, motor_id, name)
