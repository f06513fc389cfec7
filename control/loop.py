"""The loop: one `tick()` is everything that happens in a servo period, for twin and hardware alike.

    sample -> supervise -> admit -> limit -> shape -> write -> publish

It runs in real time in a process of its own (`control.process`) or in lockstep on a virtual clock
(`control.session`), unchanged.
"""

from collections.abc import Sequence

from robotctl.control.frame_ring import FrameRing
from robotctl.control.kinematics import Kinematics
from robotctl.control.motion import Motion
from robotctl.control.neighbours import Neighbours
from robotctl.control.operator import Operator, Verb
from robotctl.control.powering import Powering
from robotctl.control.publisher import Publisher
from robotctl.control.shared import Link
from robotctl.control.task_reset import Step, TaskReset
from robotctl.hal.backend import Rig
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, Sample
from robotctl.safety.deadman import Grip
from robotctl.safety.guard import Guard
from robotctl.safety.machine import ENABLED, Event, State
from robotctl.safety.overrun import Overrun
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.target import FreeDrive, JointTorque, JointVelocity
from robotctl.safety.trip import Category, Protection, Trip

_LARGEST_GAP = 25
"""Skipped periods that the reference follows; a longer gap shows as a tracking error."""
_MOVING = (State.RUN, State.RESET)


class Loop:
    """The control of one arm. `link` is where targets and requests come from and ticks and events go to."""

    def __init__(
        self,
        robot: Robot,
        rig: Rig,
        clock: Clock,
        link: Link,
        reset: Sequence[Step] = (),
        frames: FrameRing | None = None,
    ) -> None:
        """Build everything that a tick needs; `reset` holds the steps of TASK_RESET, `frames` remembers the bus's.

        Raises:
            ConfigError: if the robot's model is not that of its profile, or it cannot do one of the steps.
        """
        self.robot = robot
        self.kinematics = Kinematics(robot)
        self._motion = Motion(robot, self.kinematics)
        self.supervisor = Supervisor(robot, self._motion.scene)
        self.lateness_ns = 0
        """How late the present tick began; set by whoever paces the loop."""
        self.skipped = 0
        """Servo periods that passed without a tick before the present one; set by whoever paces the loop."""
        self._clock = clock
        self._link = link
        self._arm = rig.arm
        self._gripper = rig.gripper
        self._overrun = Overrun(robot)
        self._neighbours = Neighbours(link)
        self._guard = Guard(robot, lambda: self.supervisor.state)
        rig.arm.inspect_with(self._guard)
        self._publisher = Publisher(link, clock, robot.dof)
        self._powering = Powering(robot, rig.arm, self._motion, self.supervisor, link.watch, self._publisher.log)
        task_reset = TaskReset(robot, self.kinematics, rig.gripper, reset)
        self._operator = Operator(
            robot, rig.arm, self.kinematics, self._motion, self.supervisor, self._powering, link, task_reset
        )
        self._estop = ""
        self._frames = frames
        if frames is not None:
            rig.arm.record_frames(frames)

    # -- life -----------------------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether the arm was released."""
        return self._powering.closed

    def bring_up(self) -> None:
        """Connect and self-test: from OFF to READY.

        Raises:
            HardwareError: if the bus or a drive is not as it should be.
        """
        self._arm.connect()
        self.supervisor.handle(Event.CONNECT)
        self._operator.selftest()

    def shut_down(self) -> None:
        """Take the torque away if it is still there, and release the arm. Harmless when already done."""
        self._powering.shut_down()

    def bus_statistics(self) -> dict[str, object] | None:
        """Return the counters of the arm's bus, if it has one."""
        return self._arm.bus_statistics()

    def request(self, verb: Verb) -> None:
        """Ask for something as the operator would, from within this process."""
        if self._link.desk.pending() is None:
            self._link.desk.ask(verb)

    def estop(self, source: str) -> None:
        """Ask for an emergency stop in the next tick. May be called from a signal handler."""
        self._estop = source

    # -- the tick -------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Do everything that is due in one servo period.

        Raises:
            BusError: if the bus is gone; the arm is stopped by the drives' own watchdogs.
        """
        now = self._clock.now_ns()
        try:
            self._listen(now)
            if not self.closed:
                self._control(now)
        except BusError as error:
            self.supervisor.trip(Trip(Protection.BUS, Category.CUT, str(error), now))
            self._publisher.report(self.supervisor, now)
            raise
        self._operator.answer(now)

    def _listen(self, now: int) -> None:
        """Take in the time, the neighbours, the switches and the operator's request."""
        supervisor, desk = self.supervisor, self._link.desk
        overrun, missing = self._overrun.check(self.lateness_ns, now), self._neighbours.check(now)
        if overrun is not None and supervisor.state in ENABLED:
            supervisor.trip(overrun)
        if missing is not None and supervisor.state in _MOVING:
            supervisor.trip(missing)
        supervisor.deadman.take(Grip(desk.grip), now)
        if desk.take_stop():
            self._operator.stop("the operator", now)
        if self._estop:
            source, self._estop = self._estop, ""
            self._operator.stop(source, now)
        powered = supervisor.state in ENABLED
        self._operator.serve(now)
        if supervisor.state in ENABLED and not powered:
            self._overrun.restart()  # enabling the drives takes its time

    def _control(self, now: int) -> None:
        """From sample to command and record."""
        supervisor, motion = self.supervisor, self._motion
        sample = supervisor.screen(self._arm.read())
        if self._frames is not None:
            self._frames.mark(now)
        self._guard.observe(sample, now, self.lateness_ns)
        self._take_refusal(now)  # of something else than this tick's motion, which is sent, and brakes
        tool = self.kinematics.tool(sample.position)
        motion.observer.step(sample)
        reference = motion.reference
        supervisor.observe(sample, tool, reference.position, reference.velocity, motion.observer.external, now)
        if supervisor.yields and supervisor.contact.touched:
            motion.give_way(sample)
        target = self._link.mailbox.take()
        if target is not None:
            supervisor.offer(target, now)
        if supervisor.state in ENABLED:
            self._drive(sample, now)
        elif supervisor.state is State.DISABLED or self._powering.damping:
            self._powering.cut(sample, now)
        if self._gripper is not None:
            self._gripper.step()
        self._take_refusal(now)
        self._publisher.warn(supervisor.drives.warning(sample), now)
        self._publisher.report(supervisor, now)
        self._publisher.record(supervisor, motion, sample, tool, self._arm.truth(), self.lateness_ns, now)

    def _drive(self, sample: Sample, now: int) -> None:
        """Send the command of a state with enabled drives."""
        supervisor, motion = self.supervisor, self._motion
        wanted, torque = motion.rest, None
        if supervisor.state is State.RUN:
            match supervisor.admitted(now):
                case JointVelocity(values=values):
                    wanted = values
                case JointTorque(values=values):
                    torque = values
                case FreeDrive():
                    torque = motion.rest
        elif supervisor.state is State.RESET:
            wanted = self._operator.reset_velocity(sample, now)
        if torque is not None:
            pushed = motion.push(torque, sample)
            if isinstance(pushed, Command):
                self._write(pushed)
                return
            supervisor.trip(pushed)
            wanted = motion.rest
        periods = 1 + min(self.skipped, _LARGEST_GAP)
        brakes = supervisor.category is Category.BRAKE_OFF
        self._write(motion.track(wanted, sample, brake=brakes, periods=periods))
        if self._take_refusal(now) and not self._guard.passed:
            # What the guard refused is taken back, and the braking that it asked for begins in this very tick. If a
            # motion has left already, it begins from there, in the next one.
            motion.take_back()
            self._write(motion.track(motion.rest, sample, brake=True))
            if self._take_refusal(now):
                motion.take_back()

    def _write(self, command: Command) -> None:
        self.supervisor.bus.sent(delivered=self._arm.write(command).delivered)

    def _take_refusal(self, now: int) -> bool:
        """Stop the arm for what the guard has refused, if anything; at once if it was braking already."""
        refusal = self._guard.take()
        if refusal is None:
            return False
        braking = self.supervisor.category in (Category.BRAKE_OFF, Category.CUT)
        category = Category.CUT if braking else Category.BRAKE_OFF
        cause = f"the guard kept a message back: {refusal.text}; this is a bug, keep the recording"
        self.supervisor.trip(Trip(refusal.protection, category, cause, now))
        return True
