"""Trouble to order, seeded and deterministic: what goes wrong with frames on the wire, and with the drives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

from robotctl.sim.motors.drive import FOREVER, EmulatedDrive, Reply
from robotctl.sim.motors.memory import NOMINAL_VOLTAGE


@dataclass(frozen=True, kw_only=True)
class Trouble:
    """Something that is wrong with one motor, or with all, for some time."""

    motor_id: int | None = None
    """ESC_ID or node id; None for every motor."""
    from_ns: int = 0
    until_ns: int = FOREVER

    @property
    def garbles(self) -> bool:
        """Whether frames that it swallows are broken on the wire, so that the host's controller reports them."""
        return False

    def begin(self, drive: EmulatedDrive) -> None:
        """Act on a drive when the time comes."""

    def end(self, drive: EmulatedDrive) -> None:
        """Undo it."""

    def hears(self, random: Random) -> bool:
        """Return whether a frame reaches the drive."""
        return True

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        """Return what becomes of the drive's replies."""
        return replies


@dataclass(frozen=True, kw_only=True)
class Mute(Trouble):
    """The motor hears and obeys, but its replies never arrive."""

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return ()


@dataclass(frozen=True, kw_only=True)
class Deaf(Trouble):
    """Nothing reaches the motor."""

    def hears(self, random: Random) -> bool:
        return False


@dataclass(frozen=True, kw_only=True)
class Drop(Trouble):
    """Frames are lost, in both directions."""

    probability: float = 0.1

    def hears(self, random: Random) -> bool:
        return random.random() >= self.probability

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [reply for reply in replies if random.random() >= self.probability]


@dataclass(frozen=True, kw_only=True)
class Unterminated(Drop):
    """A bus without its resistors: reflections break frames in both directions, and the controllers notice."""

    probability: float = 0.2

    @property
    def garbles(self) -> bool:
        return True


@dataclass(frozen=True, kw_only=True)
class Delay(Trouble):
    """Replies come late; with jitter, also out of order."""

    delay_s: float = 0.005
    jitter_s: float = 0.0
    """Largest additional delay."""

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [
            reply._replace(stamp_ns=reply.stamp_ns + int((self.delay_s + self.jitter_s * random.random()) * 1e9))
            for reply in replies
        ]


@dataclass(frozen=True, kw_only=True)
class Duplicate(Trouble):
    """Replies come twice."""

    probability: float = 1.0

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [copy for reply in replies for copy in (reply,) * (1 + (random.random() < self.probability))]


@dataclass(frozen=True, kw_only=True)
class Corrupt(Trouble):
    """A bit of a reply is flipped on its way, past the CRC: a broken adapter, not a noisy line."""

    probability: float = 0.1

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [self._flip(reply, random) if random.random() < self.probability else reply for reply in replies]

    def _flip(self, reply: Reply, random: Random) -> Reply:
        data = bytearray(reply.data)
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
        return reply._replace(data=bytes(data))


@dataclass(frozen=True, kw_only=True)
class Stuck(Trouble):
    """The joint has seized up."""

    def begin(self, drive: EmulatedDrive) -> None:
        drive.shaft.jam(jammed=True)

    def end(self, drive: EmulatedDrive) -> None:
        drive.shaft.jam(jammed=False)


@dataclass(frozen=True, kw_only=True)
class Runaway(Trouble):
    """The drive turns with a torque of its own, whatever it is told."""

    torque: float = 1.0
    """Nm of the motor"""

    def begin(self, drive: EmulatedDrive) -> None:
        drive.shaft.run_away(self.torque)

    def end(self, drive: EmulatedDrive) -> None:
        drive.shaft.run_away(None)


@dataclass(frozen=True, kw_only=True)
class PowerCut(Trouble):
    """The supply fails; when it comes back, the drive starts from its flash, disabled."""

    def begin(self, drive: EmulatedDrive) -> None:
        drive.power_down()

    def end(self, drive: EmulatedDrive) -> None:
        drive.power_up()


@dataclass(frozen=True, kw_only=True)
class Failure(Trouble):
    """The drive reports a fault and switches itself off. It can be cleared at once."""

    status: int | None = None
    """A DAMIAO status or a CiA 402 error code; None for over-current."""

    def begin(self, drive: EmulatedDrive) -> None:
        drive.fail(self.status)


@dataclass(frozen=True, kw_only=True)
class UnderVoltage(Trouble):
    """The supply sags: the drive measures so little that it switches itself off, and clearing does not help."""

    voltage: float = 11.0

    def begin(self, drive: EmulatedDrive) -> None:
        drive.supply(self.voltage)

    def end(self, drive: EmulatedDrive) -> None:
        drive.supply(NOMINAL_VOLTAGE)


@dataclass(frozen=True, kw_only=True)
class WrongZero(Trouble):
    """The zero in its flash is not the joint's: it was set elsewhere, or the motor was taken off and put back."""

    offset: float = 1.0
    """By how much it reports too much, rad of the motor."""

    def begin(self, drive: EmulatedDrive) -> None:
        drive.shift_zero(self.offset)

    def end(self, drive: EmulatedDrive) -> None:
        drive.shift_zero(-self.offset)


@dataclass(frozen=True, kw_only=True)
class Misreport(Trouble):
    """The feedback tells of another angle: an encoder that slipped."""

    offset: float = 1.0
    """rad of the motor"""
    tell: Callable[[Reply, float], Reply]
    """The drive's `shifted`."""

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [self.tell(reply, self.offset) for reply in replies]


@dataclass(frozen=True, kw_only=True)
class Frozen(Trouble):
    """The feedback tells of a motor at rest at one angle, however it moves: an encoder that is stuck."""

    angle: float = 0.0
    """rad of the motor"""
    tell: Callable[[Reply, float], Reply]
    """The drive's `frozen`."""

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [self.tell(reply, self.angle) for reply in replies]


@dataclass(frozen=True, kw_only=True)
class Short(Trouble):
    """Replies lose their last bytes."""

    length: int = 6

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [reply._replace(data=reply.data[: self.length]) for reply in replies]


@dataclass(frozen=True, kw_only=True)
class Weak(Trouble):
    """The drive applies a part of the torque that it should; with a negative part, in the wrong direction."""

    part: float = 0.5

    def begin(self, drive: EmulatedDrive) -> None:
        drive.shaft.weaken(self.part)

    def end(self, drive: EmulatedDrive) -> None:
        drive.shaft.weaken(1.0)
