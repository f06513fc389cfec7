"""The loop: one `tick()` is everything that happens in a servo period, for twin and hardware alike.

    sample -> supervise -> admit -> limit -> shape -> write -> publish

It runs in real time in a process of its own (`control.process`) or in lockstep on a virtual clock
(`control.session`), unchanged.
"""

from enum import IntEnum

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.control.lowering import gravity_share
from robotctl.control.motion import Motion
from robotctl.control.publisher import Publisher
from robotctl.control.pulse import Pulse
from robotctl.control.shared import Link, Power
from robotctl.hal.backend import Rig
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, RobotctlError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, Sample, Vector
from robotctl.safety.deadman import Grip
from robotctl.safety.guard import Guard
from robotctl.safety.machine import ENABLED, Event, Refused, State, after
from robotctl.safety.overrun import Overrun
from robotctl.safety.routines import Goto, Retreat, Routine, Settle
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.target import FreeDrive, JointTorque, JointVelocity
from robotctl.safety.trip import Category, Protection, Trip

_LARGEST_GAP = 25
"""Skipped periods that the reference follows; a longer gap shows as a tracking error."""
_OPERATOR_SILENCE_NS = 1_000_000_000
"""Time without a beat from the operator's process after which what moves is stopped."""
_WATCHMAN_SILENCE_NS = 1_000_000_000
"""The same for the watchman: an arm whose loop nobody watches does not move on."""


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


_VERBS = frozenset(Verb)


class Loop:
    """The control of one arm. `link` is where targets and requests come from and ticks and events go to."""

    def __init__(self, robot: Robot, rig: Rig, clock: Clock, link: Link) -> None:
        self.robot = robot
        self.kinematics = Kinematics(robot)
        self._motion = Motion(robot, self.kinematics)
        self.supervisor = Supervisor(robot, self._motion.scene)
        self.closed = False
        self.lateness_ns = 0
        """How late the present tick began; set by whoever paces the loop."""
        self.skipped = 0
        """Servo periods that passed without a tick before the present one; set by whoever paces the loop."""
        self._overrun = Overrun(robot)
        self._arm = rig.arm
        self._gripper = rig.gripper
        self._guard = Guard(robot, lambda: self.supervisor.state)
        rig.arm.inspect_with(self._guard)
        self._clock = clock
        self._link = link
        self._publisher = Publisher(link, clock, robot.dof)
        self._routine: Routine | None = None
        self._routine_ends_ns = 0
        self._estop: str = ""
        self._damping = False
        self._lowering_ns: int | None = None
        self._closing = False
        self._answer: tuple[int, str] | None = None
        self._operator = Pulse()
        self._watchman = Pulse()

    # -- life -----------------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Connect and self-test: from OFF to READY.

        Raises:
            HardwareError: if the bus or a drive is not as it should be.
        """
        self._arm.connect()
        self.supervisor.handle(Event.CONNECT)
        self._selftest()

    def shut_down(self) -> None:
        """Take the torque away if it is still there, and release the arm. Harmless when already done."""
        if not self.closed:
            self.closed = True
            try:
                self._switch_off()
            finally:
                self._arm.close()

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
            self._tick(now)
        except BusError as error:
            self.supervisor.trip(Trip(Protection.BUS, Category.CUT, str(error), now))
            self._publisher.report(self.supervisor, now)
            raise

    def _tick(self, now: int) -> None:
        supervisor, motion = self.supervisor, self._motion
        overrun = self._overrun.check(self.lateness_ns, now)
        if overrun is not None and supervisor.state in ENABLED:
            supervisor.trip(overrun)
        if self._link.desk.take_stop():
            self._serve_estop("the operator", now)
        self._watch_neighbours(now)
        supervisor.deadman.take(Grip(self._link.desk.grip), now)
        if self._estop:
            source, self._estop = self._estop, ""
            self._serve_estop(source, now)
        request = self._link.desk.pending()
        if request is not None:
            self._serve(*request, now)
            if self.closed:
                return
        sample = supervisor.screen(self._arm.read())
        self._guard.observe(sample, now, self.lateness_ns)
        tool = self.kinematics.tool(sample.position)
        motion.observer.step(sample)
        supervisor.observe(sample, tool, motion.reference.position, motion.reference.velocity, now)
        target = self._link.mailbox.take()
        if target is not None:
            supervisor.offer(target, now)
        if supervisor.state in ENABLED:
            self._drive(sample, now)
        elif supervisor.state is State.DISABLED or self._damping:
            self._cut(sample, now)
        if self._gripper is not None:
            self._gripper.step()
        self._take_refusal(now)
        self._publisher.report(supervisor, now)
        self._publisher.record(supervisor, motion, sample, tool, self._arm.truth(), self.lateness_ns, now)
        self._give_answer(now)

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
            wanted = self._routine_velocity(sample, now)
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
        if self._take_refusal(now):
            # What the guard refused is taken back, and the braking that it asked for begins in this very tick.
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

    def _cut(self, sample: Sample, now: int) -> None:
        """The profile's category 0 action: drives off, or damped with gravity compensated until told otherwise."""
        clean = self.supervisor.cause is None
        if self.supervisor.state is State.DISABLED:
            self._damping = self.robot.profile.category0 == "damp"
            if clean and self._lowering_ns is None:
                self._lowering_ns = now
            if self._damping and not clean:
                self.supervisor.handle(Event.OFF_FAULT)
        if self._damping and sample.enabled and not self.supervisor.feedback.lost:
            share = 1.0 if self._lowering_ns is None else gravity_share(self._lowering_ns, now)
            if share > 0.0:
                self._arm.write(self._motion.damp(sample.position, share))
                return
        self._damping = False
        self._lowering_ns = None
        try:
            self._switch_off()
        except RobotctlError as error:
            # A drive that does not confirm keeps the arm from READY, but must not end the supervision of the others.
            clean = False
            self._publisher.log(str(error), now)
        if self.supervisor.state is State.DISABLED:
            self.supervisor.handle(Event.OFF_CLEAN if clean else Event.OFF_FAULT)
        if self._closing:
            self._close(now)

    def _routine_velocity(self, sample: Sample, now: int) -> Vector:
        routine = self._routine
        if routine is None or self.supervisor.feedback.stale:
            return self._motion.rest
        velocity = routine.velocity(sample, self._motion.reference.position)
        if velocity is None:
            self._routine = None
            self.supervisor.handle(Event.RESET_DONE)
            return self._motion.rest
        if now > self._routine_ends_ns:
            cause = f"reset routine {routine.name!r} did not arrive within {routine.timeout_s:g} s"
            self.supervisor.trip(Trip(Protection.RESET, Category.BRAKE_HOLD, cause, self._routine_ends_ns))
            return self._motion.rest
        return velocity

    # -- the operator ---------------------------------------------------------------------------------------------

    def _serve(self, number: int, verb: int, now: int) -> None:
        """Carry out one request and answer it. A refused request changes nothing."""
        text = ""
        try:
            if verb not in _VERBS:
                raise RobotctlError(f"there is no verb {verb}")
            self._carry_out(Verb(verb), now)
        except (Refused, RobotctlError) as error:
            text = str(error)
        self._answer = (number, text)
        if self.closed:
            self._give_answer(now)

    def _give_answer(self, now: int) -> None:
        """Answer the request of this tick, after its record is out: who asked must find the state it led to."""
        if self._answer is not None:
            number, text = self._answer
            self._answer = None
            self._link.events.write({"type": "answer", "stamp_ns": now, "number": number, "ok": not text, "text": text})
            self._link.desk.answer(number)

    def _carry_out(self, verb: Verb, now: int) -> None:
        supervisor = self.supervisor
        match verb:
            case Verb.ARM:
                after(supervisor.state, Event.ARM)
                if not supervisor.stands(self._arm.read()):
                    raise RobotctlError("ARM is refused: the arm is moving (P21)", "wait until it stands")
                supervisor.handle(Event.ARM)
                self._enable(now)
            case Verb.START:
                supervisor.handle(Event.START)
                supervisor.admission.begin(now)
            case Verb.HOME:
                self._reset(Goto(self.robot, np.array(self.robot.profile.home), "home", self.kinematics), now)
            case Verb.PARK:
                self._reset(Goto(self.robot, np.array(self.robot.profile.rest), "park", self.kinematics), now)
            case Verb.RETREAT:
                self._reset(Retreat(self.robot, self.kinematics, self._motion.scene), now)
            case Verb.SETTLE:
                self._reset(Settle(self.robot), now)
            case Verb.STOP:
                supervisor.handle(Event.STOP)
            case Verb.DISARM:
                supervisor.handle(Event.DISARM)
            case Verb.ACK if self._damping:
                self._lowering_ns = self._lowering_ns or now
                raise RobotctlError("the arm is being lowered first", "acknowledge again once it is down")
            case Verb.ACK:
                if supervisor.handle(Event.ACK) is State.SILENT:
                    self._switch_off()
                    self._selftest()
            case Verb.SELFTEST:
                self._selftest()
            case Verb.ESTOP:
                self._serve_estop("the operator", now)
            case Verb.CLOSE:
                self._close(now)

    def _reset(self, routine: Routine, now: int) -> None:
        if self.supervisor.recovery and not isinstance(routine, Retreat):
            raise Refused(self.supervisor.state, Event.RESET)
        self.supervisor.handle(Event.RESET)
        self._routine = routine
        self._routine_ends_ns = now + round(routine.timeout_s * 1e9)

    def _selftest(self) -> None:
        after(self.supervisor.state, Event.SELFTEST)  # refused before anything is asked of the drives
        self._arm.verify()
        self.supervisor.handle(Event.SELFTEST)

    def _enable(self, now: int) -> None:
        # Drives that come on hold with the last feed-forward they were given.
        self._arm.write(self._motion.begin(self._arm.read().position))
        self._link.watch.power = Power.CHANGING
        try:
            self._arm.enable()
        except RobotctlError as error:
            self.supervisor.trip(Trip(Protection.DRIVE, Category.BRAKE_OFF, str(error), now))
            raise
        self._link.watch.power = Power.ON
        self._overrun.restart()
        sample = self._arm.read()
        self._motion.begin(sample.position)
        self.supervisor.begin_recovery_if_outside(sample, self.kinematics.tool(sample.position))

    def _switch_off(self) -> None:
        """Take the torque away, and let the watchman know that this may take its time."""
        watch = self._link.watch
        watch.power = min(watch.power, Power.CHANGING)
        self._arm.disable()
        watch.power = Power.OFF

    def _close(self, now: int) -> None:
        """Release the arm at once, or after a damped one was lowered."""
        if self._damping:
            self._closing = True
            self._lowering_ns = self._lowering_ns or now
        else:
            self.supervisor.handle(Event.CLOSE)
            self.shut_down()

    def _watch_neighbours(self, now: int) -> None:
        """Stop what moves when operator or watchman, once they have shown life, are suspended, blocked or gone."""
        beats, watched = self._link.desk.beats, self._link.watch.beats
        silence = self._operator.silence_ns(beats, now)
        unwatched = self._watchman.silence_ns(watched, now)
        if self.supervisor.state not in (State.RUN, State.RESET):
            return
        if beats and silence > _OPERATOR_SILENCE_NS:
            self._stop_unattended(Protection.OPERATOR, "operator's process", _OPERATOR_SILENCE_NS, silence, now)
        if watched and unwatched > _WATCHMAN_SILENCE_NS:
            self._stop_unattended(Protection.WATCHMAN, "watchman", _WATCHMAN_SILENCE_NS, unwatched, now)

    def _stop_unattended(self, protection: Protection, who: str, limit_ns: int, silence_ns: int, now: int) -> None:
        cause = f"the {who} has been silent for {limit_ns / 1e9:g} s"
        self.supervisor.trip(Trip(protection, Category.BRAKE_HOLD, cause, now - silence_ns + limit_ns))

    def _serve_estop(self, source: str, now: int) -> None:
        cause = f"emergency stop by {source}; release it, then acknowledge"
        self.supervisor.trip(Trip(Protection.ESTOP, Category.BRAKE_OFF, cause, now))
