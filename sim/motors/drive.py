"""What the emulated bus, its server and its troubles know of a drive, whatever protocol that speaks."""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from robotctl.sim.motors.shaft import Shaft
from robotctl.sim.motors.thermal import Thermal

FOREVER = 1 << 62
"""A time that never comes, ns."""

Handler = Callable[[bytes, int], bytes | None]
"""Takes the data of a frame and the time, ns; returns what is answered on the drive's reply id, or None."""

Defer = Callable[[int, Callable[[], None]], None]
"""Takes a time in ns and what to do then."""


class Reply(NamedTuple):
    """A frame from a drive."""

    arbitration_id: int
    data: bytes
    fd: bool
    stamp_ns: int
    """When it appears on the wire."""


class EmulatedDrive(Protocol):
    """A drive with its shaft. It knows no bus and no clock: frames and time are handed to it."""

    name: str
    """The joint's."""
    model: str
    powered: bool
    fed_ns: int
    """When what its watchdog waits for last reached it."""
    shaft: Shaft
    thermal: Thermal

    @property
    def id(self) -> int:
        """What it listens to."""
        ...

    @property
    def reply_id(self) -> int:
        """What its answers come on; the first of several."""
        ...

    @property
    def fd(self) -> bool:
        """Whether it answers in CAN FD."""
        ...

    @property
    def status(self) -> object:
        """Changes with everything that is worth telling a person."""
        ...

    @property
    def enabled(self) -> bool: ...

    @property
    def is_faulty(self) -> bool:
        """Whether it has a fault that has to be cleared."""
        ...

    @property
    def angle(self) -> float:
        """The motor's, as it would report it without noise, rad."""
        ...

    @property
    def deadline_ns(self) -> int:
        """When its watchdog will bite unless it is fed before."""
        ...

    @property
    def is_servoing(self) -> bool:
        """Whether `step` has to be called as time passes."""
        ...

    @property
    def cycles(self) -> int:
        """Times its settings were stored."""
        ...

    def routes(self, bitrate: int) -> Mapping[int, Handler]:
        """Return what it does with frames, by id, on a bus of this bit rate."""
        ...

    def told(self, status: object) -> str:
        """Return a status in words."""
        ...

    def step(self, seconds: float) -> None:
        """Run its own loop."""
        ...

    def expire(self) -> None:
        """Let the watchdog bite."""
        ...

    def warm(self, seconds: float) -> None:
        """Let `seconds` of the present torque heat it, and switch it off when it is too hot."""
        ...

    def power_up(self) -> None: ...

    def power_down(self) -> None: ...

    def fail(self, code: int | None = None) -> None:
        """Report a fault, in the protocol's terms, or over-current, and go off."""
        ...

    def supply(self, voltage: float) -> None:
        """Get this at the supply, V; too little is a fault."""
        ...

    def shift_zero(self, offset: float) -> None:
        """Report angles that are larger by `offset`, rad, as if its zero had been set elsewhere."""
        ...

    def set_watchdog(self, seconds: float) -> None:
        """Store how long it waits for its host; 0 is for ever."""
        ...

    def shifted(self, reply: Reply, angle: float) -> Reply:
        """Return what a reply would be with an encoder that is off by `angle`, rad."""
        ...

    def frozen(self, reply: Reply, angle: float) -> Reply:
        """Return what a reply would be with an encoder that is stuck at `angle`, rad."""
        ...
