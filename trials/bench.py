"""The bench: a loop on one arm with its plant at hand, ticked one by one on a virtual clock."""

from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robotctl.control.loop import Loop
from robotctl.control.operator import Verb
from robotctl.control.shared import Link
from robotctl.hal.arm import Arm
from robotctl.hal.backend import Rig, open_backend
from robotctl.hal.can.arm import CanArm
from robotctl.hal.can.joined import JoinedArm
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import HardwareError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.machine import State
from robotctl.safety.target import Target
from robotctl.sim.backend import SimArm
from robotctl.sim.motors.bench import Bench as Motors
from robotctl.sim.motors.bus import EmulatedBus
from robotctl.sim.motors.drive import EmulatedDrive
from robotctl.sim.plant import Plant
from robotctl.sim.trouble import TroubledArm

POLICY_S = 0.05
"""Period of a policy."""
_START_NS = 1_000_000_000
_HISTORY_S = 60.0
_VALID_S = 0.1
_SETTLE_S = 0.05

Policy = Callable[["Bench", float], Target | None]
"""What the bench's policy wants at a time, s since it began; None for silence."""


def emulated_buses(arm: Arm) -> list[EmulatedBus]:
    """Return the emulated buses that an arm is on."""
    if isinstance(arm, JoinedArm):
        channels = arm.channels
    else:
        channels = [arm.channel] if isinstance(arm, CanArm) and arm.channel is not None else []
    return [channel.bus for channel in channels if isinstance(channel.bus, EmulatedBus)]


def plant_behind(arm: Arm) -> Plant:
    """Return the plant that an arm moves.

    Raises:
        HardwareError: if it is a real one.
    """
    if isinstance(arm, SimArm):
        return arm.plant
    buses = emulated_buses(arm)
    if not buses:
        raise HardwareError("there is no plant behind this arm")
    return buses[0].bench.plant  # that of them all


class Bench:
    """One arm under test, brought up in its home pose. Everything random in it comes from the seed."""

    def __init__(self, robot: Robot, backend: str, seed: int = 0) -> None:
        self.robot = robot
        self.backend = backend
        self.seed = seed
        self.random = np.random.default_rng(seed)
        self.clock = VirtualClock(_START_NS)
        self.link = Link.local(robot.dof, round(_HISTORY_S * robot.profile.servo_hz))
        self._rig = open_backend(backend, robot, self.clock)
        self.arm = TroubledArm(self._rig.arm)
        self.loop = Loop(robot, Rig(self.arm, self._rig.gripper), self.clock, self.link)
        self.policy: Policy | None = None
        self.attended = False
        """Whether the operator's process shows that it is alive."""
        self.trips: list[dict[str, Any]] = []
        self._answers: dict[int, str] = {}
        self._events = 0
        self._targets = 0
        self._begun_ns = 0
        self._due_ns = 0
        self._late = 0.0

    def __enter__(self) -> Self:
        self.loop.bring_up()
        self.place(np.array(self.robot.profile.home))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.arm.close()

    # -- what is behind it ----------------------------------------------------------------------------------------

    @property
    def twin(self) -> SimArm | None:
        """The arm, if it is the twin."""
        arm = self._rig.arm
        return arm if isinstance(arm, SimArm) else None

    @property
    def buses(self) -> list[EmulatedBus]:
        """The buses, if the arm is on emulated motors; there are none on the twin."""
        return emulated_buses(self._rig.arm)

    @property
    def drives(self) -> list[EmulatedDrive]:
        """The emulated drives of all buses, the grippers', too."""
        return [drive for bus in self.buses for drive in bus.bench.drives]

    def motors_of(self, axis: int) -> Motors:
        """Return the emulated motors of the bus that a joint's drive is on.

        Raises:
            HardwareError: if there are none.
        """
        drive = self.robot.profile.joints[axis].drive
        if not self.buses or drive is None:
            raise HardwareError(f"there are no emulated motors behind {self.backend}")
        return self.buses[drive.bus].bench

    def drive(self, axis: int) -> EmulatedDrive:
        """Return the emulated drive of a joint."""
        return self.motors_of(axis).drive(self.robot.profile.joints[axis].name)

    def statistics(self) -> list[dict[str, Any]]:
        """Return the counters of every bus; there are none on the twin."""
        statistics: dict[str, Any] = self.arm.bus_statistics() or {}
        return statistics.get("buses") or ([statistics] if statistics else [])

    def count(self, counter: str) -> int:
        """Return what a counter has come to on all buses."""
        return sum(int(each[counter]) for each in self.statistics())

    @property
    def plant(self) -> Plant:
        return plant_behind(self._rig.arm)

    # -- time -----------------------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns()

    @property
    def state(self) -> State:
        return self.loop.supervisor.state

    @property
    def position(self) -> Vector:
        """Measured joints (n,) of the last tick, rad."""
        record = self.link.ticks.latest()
        assert record is not None
        return np.array(record["position"])

    def tick(self, late: float = 0.0) -> State:
        """Make the tick that is due next, some servo periods late, with the policy's target if one is due.

        As in real time, deadlines are absolute, and missed ones are skipped.
        """
        period = self.robot.period_ns
        self.clock.sleep_until(self.now_ns + round((1.0 + late - self._late) * period))
        self.loop.lateness_ns, self.loop.skipped = round(late * period), int(late)
        self._late = late % 1.0
        if self.attended:
            self.link.desk.beat()
        if self.policy is not None and self.now_ns >= self._due_ns:
            self._due_ns += round(POLICY_S * 1e9)
            target = self.policy(self, (self.now_ns - self._begun_ns) * 1e-9)
            if target is not None:
                self.link.mailbox.put(target)
        self.loop.tick()
        self.take_events()
        return self.state

    def let_pass(self, nanoseconds: int) -> None:
        """Let time pass without a tick: the plant and its drives go on by themselves."""
        self.clock.sleep_until(self.now_ns + nanoseconds)
        if self.twin:
            self.twin.read()
        else:
            self.buses[0].advance(self.now_ns)  # and all others with it

    def run(self, seconds: float) -> State:
        """Tick for some time."""
        for _ in range(max(1, round(seconds * self.robot.profile.servo_hz))):
            self.tick()
        return self.state

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Tick until something is so, for some time at most, and return whether it is."""
        for _ in range(round(seconds * self.robot.profile.servo_hz)):
            if condition():
                return True
            self.tick()
        return condition()

    # -- the operator ---------------------------------------------------------------------------------------------

    def ask(self, verb: Verb) -> str:
        """Ask for something, and return why it was refused; empty if it was not.

        Raises:
            HardwareError: if the loop does not answer.
        """
        number = self.link.desk.ask(verb)
        if not self.until(lambda: number in self._answers, 1.0):
            raise HardwareError(f"the loop did not answer {verb.name}")
        return self._answers.pop(number)

    def demand(self, verb: Verb) -> None:
        """Ask for something that must not be refused.

        Raises:
            HardwareError: if it is.
        """
        text = self.ask(verb)
        if text:
            raise HardwareError(f"{verb.name} was refused: {text}")

    def place(self, pose: Vector) -> None:
        """Put an arm whose drives are off somewhere, and let the loop see it."""
        self.plant.place(pose)
        self.run(_SETTLE_S)

    def start(self, policy: Policy) -> None:
        """Arm, and hand the arm to a policy."""
        self.demand(Verb.ARM)
        self.run(_SETTLE_S)
        self.hand_over(policy)

    def hand_over(self, policy: Policy) -> None:
        """From ARMED, start a policy."""
        self.policy = policy
        self._begun_ns = self._due_ns = self.now_ns
        self.demand(Verb.START)

    # -- the policy -----------------------------------------------------------------------------------------------

    def stamp(self) -> tuple[int, int, int]:
        """Return epoch, sequence number and deadline of the next target."""
        self._targets += 1
        return self.loop.supervisor.epoch, self._targets, self.now_ns + round(_VALID_S * 1e9)

    # -- what happened --------------------------------------------------------------------------------------------

    def since(self, stamp_ns: int) -> NDArray[Any]:
        """Return the records of the ticks from a time on."""
        records, _, _ = self.link.ticks.since(0)
        return records[records["stamp_ns"] >= stamp_ns]

    def take_events(self) -> None:
        """Take in what the loop has told since the last tick."""
        events, self._events = self.link.events.since(self._events)
        for event in events:
            if event["type"] == "answer":
                self._answers[event["number"]] = event["text"]
            elif event["type"] == "trip":
                self.trips.append(event)
