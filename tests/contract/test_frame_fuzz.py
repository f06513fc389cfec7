"""A million random, truncated and reordered frames on the bus: no crash, no false state, nothing strange sent."""

from collections import deque
from random import Random

import numpy as np
import pytest

from robotctl.control.session import LockstepSession
from robotctl.hal.can.damiao.codec import BROADCAST_ID, Offset
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity
from robotctl.sim.motors.trouble import Reply

FRAMES = 1_000_000
PER_TICK = 250


def name_of_protocol(robot: Robot) -> str:
    return robot.profile.joints[0].drive.protocol


def is_strange(robot: Robot, arbitration_id: int, data: bytes) -> bool:
    """Return whether a frame is not what a host sends: of another length, or one that clears, sets a zero, stops."""
    if name_of_protocol(robot) == "cia402":
        word = data[0] if arbitration_id & 0x780 == 0x200 else 0
        return len(data) != {0x000: 2, 0x200: 7, 0x300: 6, 0x600: 8, 0x700: 1, 0x080: 0}[
            arbitration_id & 0x780
        ] or word not in (0x00, 0x06, 0x07, 0x0F)
    return len(data) != 8 or (data[:7] == b"\xff" * 7 and data[7] not in (0xFC, 0xFD))


class Fuzz:
    """A session on emulated drives whose bus carries whatever a test invents, and whose sent frames are looked at."""

    def __init__(self, name: str, seed: int) -> None:
        self.robot = load_robot(name)
        self.session = LockstepSession(self.robot, "can")
        self.random = Random(seed)
        self.strange: list[tuple[int, bytes]] = []
        self.heard: deque[Reply] = deque(maxlen=60)
        self.seq = 0
        self.injected = 0

    def __enter__(self) -> "Fuzz":
        self.session.__enter__()
        bus = self.session._rig.arm._channel.bus
        self.bench = bus.bench
        motors = self.bench.drives
        if name_of_protocol(self.robot) == "cia402":
            self.replies = [base + drive.id for drive in motors for base in (0x080, 0x180, 0x280, 0x700)]
            known = {base + drive.id for drive in motors for base in (0x200, 0x300, 0x600)} | {0x000, 0x080, 0x77F}
        else:
            self.replies = [drive.reply_id for drive in motors]
            known = {*(drive.id for drive in motors), BROADCAST_ID, motors[-1].id + Offset.POS_FORCE}
        receive = bus._receive

        def look(arbitration_id: int, data: bytes) -> None:
            if arbitration_id not in known or is_strange(self.robot, arbitration_id, bytes(data)):
                self.strange.append((arbitration_id, bytes(data)))
            receive(arbitration_id, data)
            self.heard.extend(list(self.bench.replies)[-1:])

        bus._receive = look
        self.session.prepare()
        self.session.begin()
        return self

    def __exit__(self, *error: object) -> None:
        self.session.__exit__(None, None, None)

    def tick(self, *frames: Reply) -> None:
        self.seq += 1
        session = self.session
        velocity = 0.3 * np.sin(0.01 * self.seq) * self.robot.limits.velocity
        deadline = session.clock.now_ns() + 100_000_000
        session.link.mailbox.put(JointVelocity(velocity, int(session.latest()["epoch"]), self.seq, deadline))
        self.bench.replies.extend(frames)
        self.injected += len(frames)
        session.advance(self.robot.period_ns * 1e-9)

    def reply(self, arbitration_id: int, length: int) -> Reply:
        return Reply(arbitration_id, self.random.randbytes(length), self.random.random() < 0.5, self.bench.now_ns)


@pytest.mark.parametrize("name", ["panda", "openarm", "xarm7"])
def test_frames_of_others_change_nothing(name: str) -> None:
    with Fuzz(name, 1) as fuzz:
        others = sorted(set(range(0x800)) - set(fuzz.replies))
        while fuzz.injected < FRAMES // 4:
            fuzz.tick(*(fuzz.reply(fuzz.random.choice(others), fuzz.random.randrange(9)) for _ in range(PER_TICK)))
        assert fuzz.session.state is State.RUN
        assert fuzz.session.trips == []
        assert fuzz.strange == []
        assert sum(fuzz.session.judge.violations.values()) == 0


@pytest.mark.parametrize("name", ["panda", "openarm", "xarm7"])
def test_frames_in_our_drives_names_stop_the_arm_and_no_more(name: str) -> None:
    with Fuzz(name, 2) as fuzz:
        while fuzz.injected < FRAMES // 4:
            fuzz.tick(
                *(fuzz.reply(fuzz.random.choice(fuzz.replies), fuzz.random.randrange(9)) for _ in range(PER_TICK))
            )
        assert fuzz.session.state is State.FAULT
        # Which one finds it first is chance: a fault nibble, a jump, a frame without sense.
        assert fuzz.session.trips[0]["protection"] in ("P14", "P15", "P24")
        assert fuzz.strange == []
        assert fuzz.session.judge.violations["velocity"] == 0
        assert not any(drive.enabled for drive in fuzz.bench.drives)


def test_truncated_repeated_and_reordered_replies_stop_the_arm_or_change_nothing() -> None:
    """What the drives themselves said, in another order, twice, cut short: never a position that is not theirs."""
    with Fuzz("panda", 3) as fuzz:
        while fuzz.injected < 50_000 and fuzz.session.state is State.RUN:
            shuffled = fuzz.random.sample(list(fuzz.heard), 10)
            if fuzz.seq % 400 == 0:
                shuffled[0] = shuffled[0]._replace(data=shuffled[0].data[: fuzz.random.randrange(8)])
            fuzz.tick(*shuffled)
            record = fuzz.session.latest()
            assert np.abs(record["position"] - record["true_position"]).max() < 0.02
        assert fuzz.strange == []
        assert sum(fuzz.session.judge.violations.values()) == 0
