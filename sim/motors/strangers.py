"""Trouble from others on the bus: nodes that talk too much, that have our id, or that talk with our drives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

from robotctl.hal.can.damiao.codec import RegisterCommand, encode_register
from robotctl.hal.can.damiao.registers import Register
from robotctl.sim.motors.drive import Reply
from robotctl.sim.motors.trouble import Trouble


@dataclass(frozen=True, kw_only=True)
class Babble(Trouble):
    """A node sends frames that nobody asked for, a few beside every reply."""

    arbitration_id: int = 0x055
    frames: int = 3

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [
            frame
            for reply in replies
            for frame in (
                reply,
                *(
                    reply._replace(arbitration_id=self.arbitration_id, data=random.randbytes(8))
                    for _ in range(self.frames)
                ),
            )
        ]


@dataclass(frozen=True, kw_only=True)
class Impostor(Trouble):
    """Another motor was given the same ids, and answers as well, from an angle of its own."""

    offset: float = 1.0
    """rad of the motor"""
    tell: Callable[[Reply, float], Reply]
    """Returns what a reply would be from so far away."""

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [answer for reply in replies for answer in (reply, self.tell(reply, self.offset))]


@dataclass(frozen=True, kw_only=True)
class Chatter(Trouble):
    """Another program reads a motor's registers meanwhile: acknowledgements that look like feedback."""

    register: int = Register.SN

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        if self.motor_id is None:
            return replies
        acknowledgement = encode_register(self.motor_id, RegisterCommand.READ, self.register)
        return [frame for reply in replies for frame in (reply, reply._replace(data=acknowledgement))]
