"""The operator's side of a loop: requests are carried out and answered, and resets are run."""

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.control.motion import Motion
from robotctl.control.powering import Powering
from robotctl.control.resetting import Resetting
from robotctl.control.shared import Link
from robotctl.control.task_reset import TaskReset
from robotctl.hal.arm import Arm
from robotctl.hal.errors import RobotctlError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.machine import Event, Refused, State, after
from robotctl.safety.routines import Goto, RandomStart, Retreat, Routine, Settle
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.trip import Category, Protection, Trip


class Verb(IntEnum):
    """What an operator may ask of a running loop."""

    ARM = 1
    START = 2
    HOME = 3
    PARK = 4
    RETREAT = 5
    SETTLE = 6
    STOP = 7
    DISARM = 8
    ACK = 9
    ESTOP = 10
    CLOSE = 11
    SELFTEST = 12
    """Again, after one that failed."""
    RANDOM_START = 13
    """With a seed as argument."""
    TASK_RESET = 14
    """The steps that the session's task brought along."""


_VERBS = frozenset(Verb)


class Operator:
    """Serves the operator of one loop."""

    def __init__(
        self,
        robot: Robot,
        arm: Arm,
        kinematics: Kinematics,
        motion: Motion,
        supervisor: Supervisor,
        powering: Powering,
        link: Link,
        task_reset: TaskReset,
    ) -> None:
        self._robot = robot
        self._arm = arm
        self._kinematics = kinematics
        self._motion = motion
        self._supervisor = supervisor
        self._powering = powering
        self._link = link
        self._task_reset = task_reset
        self._resetting: Resetting | None = None
        self._answer: tuple[int, str] | None = None

    def serve(self, now_ns: int) -> None:
        """Carry out the request that waits, if one does. One that is refused changes nothing."""
        request = self._link.desk.pending()
        if request is None:
            return
        number, verb = request
        text = ""
        try:
            if verb not in _VERBS:
                raise RobotctlError(f"there is no verb {verb}")
            self._carry_out(Verb(verb), now_ns)
        except (Refused, RobotctlError) as error:
            text = str(error)
        self._answer = (number, text)

    def answer(self, now_ns: int) -> None:
        """Answer the request of this tick, after its record is out: who asked must find the state it led to."""
        if self._answer is not None:
            number, text = self._answer
            self._answer = None
            event = {"type": "answer", "stamp_ns": now_ns, "number": number, "ok": not text, "text": text}
            self._link.events.write(event)
            self._link.desk.answer(number)

    def stop(self, source: str, now_ns: int) -> None:
        """Stop in an emergency."""
        cause = f"emergency stop by {source}; release it, then acknowledge"
        self._supervisor.trip(Trip(Protection.ESTOP, Category.BRAKE_OFF, cause, now_ns))

    def selftest(self) -> None:
        """Have the drives verified: from SILENT to READY.

        Raises:
            Refused: in another state.
            HardwareError: if a drive is not as it should be.
        """
        after(self._supervisor.state, Event.SELFTEST)  # refused before anything is asked of the drives
        self._arm.verify()
        self._supervisor.handle(Event.SELFTEST)

    def reset_velocity(self, sample: Sample, now_ns: int) -> Vector:
        """Return the joint velocity (n,), rad/s, that the reset in progress wants now."""
        resetting, rest = self._resetting, self._motion.rest
        if resetting is None or self._supervisor.feedback.stale:
            return rest
        velocity = resetting.velocity(sample, self._motion.reference.position, now_ns)
        if isinstance(velocity, Trip):
            self._supervisor.trip(velocity)
            return rest
        if velocity is None:
            self._resetting = None
            self._supervisor.handle(Event.RESET_DONE)
            return rest
        return velocity

    def _carry_out(self, verb: Verb, now_ns: int) -> None:
        supervisor, profile = self._supervisor, self._robot.profile
        match verb:
            case Verb.ARM:
                self._arm_it(now_ns)
            case Verb.START:
                supervisor.handle(Event.START)
                supervisor.admission.begin(now_ns)
            case Verb.HOME:
                self._reset([self._goto(pose, "home") for pose in (*profile.home_via, profile.home)], now_ns)
            case Verb.PARK:
                self._reset([self._goto(profile.rest, "park")], now_ns)
            case Verb.RETREAT:
                self._reset([Retreat(self._robot, self._kinematics, self._motion.scene)], now_ns)
            case Verb.SETTLE:
                self._reset([Settle(self._robot)], now_ns)
            case Verb.RANDOM_START:
                seed = self._link.desk.argument
                self._reset([RandomStart(self._robot, seed, self._kinematics, self._motion.scene)], now_ns)
            case Verb.TASK_RESET:
                routines = self._task_reset.routines()
                if not routines:
                    raise RobotctlError("the task has no reset")
                self._reset(routines, now_ns)
            case Verb.STOP:
                supervisor.handle(Event.STOP)
            case Verb.DISARM:
                supervisor.handle(Event.DISARM)
            case Verb.ACK:
                self._acknowledge(now_ns)
            case Verb.SELFTEST:
                self.selftest()
            case Verb.ESTOP:
                self.stop("the operator", now_ns)
            case Verb.CLOSE:
                self._powering.close(now_ns)

    def _arm_it(self, now_ns: int) -> None:
        after(self._supervisor.state, Event.ARM)
        if not self._supervisor.stands(self._arm.read()):
            raise RobotctlError("ARM is refused: the arm is moving (P21)", "wait until it stands")
        self._supervisor.handle(Event.ARM)
        sample = self._powering.on(now_ns)
        self._supervisor.begin_recovery_if_outside(sample, self._kinematics.tool(sample.position))

    def _acknowledge(self, now_ns: int) -> None:
        if self._powering.damping:
            self._powering.lower(now_ns)
            raise RobotctlError("the arm is being lowered first", "acknowledge again once it is down")
        if self._supervisor.handle(Event.ACK) is State.SILENT:
            self._powering.off()
            self.selftest()

    def _reset(self, routines: Sequence[Routine], now_ns: int) -> None:
        if self._supervisor.recovery and not isinstance(routines[0], Retreat):
            raise Refused(self._supervisor.state, Event.RESET, "the arm is outside its limits; retreat first")
        self._supervisor.handle(Event.RESET)
        self._resetting = Resetting(self._robot, routines, now_ns)

    def _goto(self, pose: Sequence[float], name: str) -> Goto:
        return Goto(self._robot, np.array(pose), name, self._kinematics)
