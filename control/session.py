"""A session: one arm with its loop, as its operator sees it. In lockstep here; in a process in `process_session`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Any, Self

import numpy as np

from robotctl.control.frame_ring import FrameRing
from robotctl.control.loop import Loop
from robotctl.control.operator import Verb
from robotctl.control.shared import Link
from robotctl.control.statistics import TickStatistics
from robotctl.control.task_reset import Step
from robotctl.hal.backend import BackendFactory, open_backend
from robotctl.hal.clock import Clock, VirtualClock
from robotctl.hal.errors import HardwareError, RobotctlError
from robotctl.hal.robot import Robot
from robotctl.safety.deadman import Grip
from robotctl.safety.judge import Judge
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip

HISTORY_S = 60.0
"""How much the ring of ticks remembers: the black box."""
_ANSWER_TIMEOUT_S = 5.0
_RESET_TIMEOUT_S = 600.0
"""The loop gives a reset up much earlier."""
_OFF = (State.OFF, State.SILENT, State.READY, State.FAULT)
_STOPPED = (State.HOLD, State.FAULT, State.READY, State.SILENT)


class Stopped(RobotctlError):  # noqa: N818 - an outcome more than an error
    """The safety supervisor stopped the arm while something was expected of it."""


def history_slots(robot: Robot) -> int:
    """Return how many ticks a session of this robot remembers."""
    return round(HISTORY_S * robot.profile.servo_hz)


def frame_slots(robot: Robot) -> int:
    """Return how many frames a session of this robot remembers: per tick and drive one each way, a mark, one spare."""
    drives = sum(joint.drive is not None for joint in robot.profile.joints) + 1
    return history_slots(robot) * (2 * drives + 2)


class Session(ABC):
    """Operator's side of a loop: requests, states, events, statistics.

    Life: `open` -> `prepare` -> (`begin` -> `advance`* -> `end`)* -> `finish`.
    """

    def __init__(self, robot: Robot, clock: Clock, link: Link) -> None:
        self.robot = robot
        self.clock = clock
        self.link = link
        self.frames: FrameRing | None = None
        """The raw frames of the bus, where there is one."""
        self.judge = Judge(robot)
        self.statistics = TickStatistics(robot.period_ns)
        self.trips: list[dict[str, Any]] = []
        self.pages: list[str] = []
        """Why the operator was called for."""
        self.on_event: Callable[[dict[str, Any]], None] | None = None
        self.on_trip: Callable[[dict[str, Any]], None] | None = None
        self.on_page: Callable[[str], None] | None = None
        self.on_switch: Callable[[], None] | None = None
        """Called when something waits for the deadman's switch to be held."""
        self.on_poll: Callable[[], None] | None = None
        self._answers: dict[int, dict[str, Any]] = {}
        self._tick_cursor = 0
        self._event_cursor = 0

    @abstractmethod
    def open(self) -> None:
        """Start the loop and bring it to READY.

        Raises:
            HardwareError: if the bus or a drive is not as it should be.
        """

    @abstractmethod
    def advance(self, seconds: float) -> None:
        """Let time pass.

        Raises:
            HardwareError: if the loop died.
        """

    @abstractmethod
    def close(self) -> None:
        """Release everything, whatever state it is in. Harmless when already closed."""

    @abstractmethod
    def bus_statistics(self) -> dict[str, object] | None:
        """Return the bus counters of `Arm.bus_statistics`."""

    def __enter__(self) -> Self:
        try:
            self.open()
        except BaseException:  # an interrupt, too, must not leave a half-open session
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- looking --------------------------------------------------------------------------------------------------

    def latest(self) -> np.void:
        """Return the newest tick record.

        Raises:
            HardwareError: before the first tick.
        """
        record = self.link.ticks.latest()
        if record is None:
            raise HardwareError("the control loop has not made a tick yet")
        return record

    @property
    def state(self) -> State:
        """The supervisor's state at the newest tick; OFF before the first."""
        record = self.link.ticks.latest()
        return State.OFF if record is None else State(int(record["state"]))

    def poll(self) -> None:
        """Take in what happened since the last call: ticks into judge and statistics, trips and answers from events."""
        if self.on_poll is not None:
            self.on_poll()
        records, self._tick_cursor, dropped = self.link.ticks.since(self._tick_cursor)
        self.judge.take(records)
        self.statistics.take(records, dropped)
        events, self._event_cursor = self.link.events.since(self._event_cursor)
        for event in events:
            self._take_event(event)
            if self.on_event is not None:
                self.on_event(event)

    def _take_event(self, event: dict[str, Any]) -> None:
        if event["type"] == "answer":
            self._answers[event["number"]] = event
        elif event["type"] == "trip":
            self.trips.append(event)
            if self.on_trip is not None:
                self.on_trip(event)
        elif event["type"] == "page":
            self.page(event["text"])

    def page(self, why: str) -> None:
        """Call for the operator."""
        self.pages.append(why)
        if self.on_page is not None:
            self.on_page(why)

    # -- asking ---------------------------------------------------------------------------------------------------

    def request(self, verb: Verb, argument: int = 0) -> None:
        """Ask the loop for something and wait for its answer.

        Args:
            argument: what the verb says it takes.

        Raises:
            Stopped: if the present state does not allow it.
            HardwareError: if the loop does not answer.
        """
        number = self.link.desk.ask(verb, argument)
        self._wait(lambda: number in self._answers, _ANSWER_TIMEOUT_S, f"the loop did not answer {verb.name}")
        answer = self._answers.pop(number)
        if not answer["ok"]:
            raise Stopped(answer["text"])

    def await_switch(self) -> None:
        """Wait until the deadman's switch is held, if there is one.

        Raises:
            Stopped: if it is unplugged.
        """
        desk = self.link.desk
        if desk.grip in (Grip.NONE, Grip.HELD):
            return
        if self.on_switch is not None:
            self.on_switch()
        while desk.grip != Grip.HELD:
            if desk.grip == Grip.UNPLUGGED:
                raise Stopped("the deadman's switch is unplugged", "plug it in and start again")
            self.advance(0.05)

    def wait_for(self, *states: State, timeout_s: float) -> State:
        """Return once the supervisor is in one of `states`.

        Raises:
            Stopped: if it comes to rest in another state, or not in time.
        """
        wanted = set(states) | set(_STOPPED)
        names = " or ".join(state.name for state in states)
        self._wait(lambda: self.state in wanted, timeout_s, f"state {names} not reached")
        if self.state not in states:
            cause = f": {self.trips[-1]['text']}" if self.trips else ""
            raise Stopped(f"expected {names}, but the supervisor is in {self.state.name}{cause}")
        return self.state

    def reset(self, routine: Verb = Verb.HOME, argument: int = 0) -> None:
        """Run a reset routine to its end.

        One that does not arrive is tried again, twice, by the loop. After that, and after any trip on the way, the
        operator is called for, and nothing is acknowledged in his place.

        Args:
            argument: the seed, for RANDOM_START.

        Raises:
            Stopped: if it is refused, or ends in anything but ARMED.
        """
        self.await_switch()
        self.request(routine, argument)
        self.wait_for(State.ARMED, timeout_s=_RESET_TIMEOUT_S)

    def prepare(self) -> None:
        """Arm, retreat if the arm stands outside its limits, and go home."""
        self.request(Verb.ARM)
        self.advance(self.robot.period_ns * 1e-9)
        if self.latest()["clip"] & Clip.RECOVERY:
            self.reset(Verb.RETREAT)
        self.reset()

    def begin(self) -> None:
        """Hand the arm to the policy."""
        self.await_switch()
        self.request(Verb.START)

    def end(self) -> None:
        """Take the arm back from the policy: brake, hold, ready for the next routine.

        Raises:
            Stopped: if a protection had stopped it meanwhile; acknowledging that is up to a person.
        """
        known = len(self.trips)
        self.request(Verb.STOP)
        self.wait_for(State.HOLD, timeout_s=10.0)
        if len(self.trips) > known:
            raise Stopped(self.trips[-1]["text"])
        self.request(Verb.ACK)

    def finish(self) -> None:
        """Park where the drives may go off, and switch them off."""
        if self.state is State.ARMED:
            self.reset(Verb.PARK)
            self.request(Verb.DISARM)
            self.wait_for(State.READY, timeout_s=10.0)
        elif self.state is State.HOLD:
            self.request(Verb.DISARM)
            self._wait(lambda: self.state in (State.READY, State.FAULT), 10.0, "the drives did not go off")

    def wind_down(self) -> None:
        """End what is going on, by the operator's word: brake, park where drives may go off, switch them off.

        An arm with brakes is not parked: it stays where it is.
        """
        self._await_pending()
        if self.state in (State.RUN, State.RESET, State.ARMED) and not self.robot.profile.brakes:
            with suppress(Stopped):  # by something that happened meanwhile
                self.end()
                self.finish()
        self.bring_to_rest(Verb.DISARM)

    def emergency_stop(self) -> None:
        """Ask for an emergency stop, without waiting. May be called from any thread."""
        self.link.desk.stop()

    def bring_to_rest(self, verb: Verb) -> None:
        """Stop with DISARM or ESTOP and wait until the drives are off, whatever the present state."""
        self._await_pending()
        if self.state not in _OFF:
            with suppress(Stopped):  # it may be stopping harder already
                self.request(verb)
            self._wait(lambda: self.state in _OFF, 10.0, "the drives did not go off")

    def _await_pending(self) -> None:
        """Wait for the answer to a request whose waiting was interrupted: it may have armed the arm."""
        self._wait(lambda: self.link.desk.pending() is None, _ANSWER_TIMEOUT_S, "the loop did not answer")

    def _wait(self, condition: Callable[[], bool], timeout_s: float, complaint: str) -> None:
        deadline = self.clock.now_ns() + round(timeout_s * 1e9)
        self.poll()
        while not condition():
            if self.clock.now_ns() > deadline:
                raise HardwareError(f"{complaint} within {timeout_s:g} s", "see the recording's log channel")
            self.advance(0.01)


class LockstepSession(Session):
    """The loop in this process on a virtual clock: as fast as the machine allows, the same every time."""

    def __init__(
        self, robot: Robot, backend: str | BackendFactory, channel: str = "", reset: Sequence[Step] = ()
    ) -> None:
        """Take a backend by name, or one of your own; `reset` holds the steps of TASK_RESET."""
        clock = VirtualClock()
        super().__init__(robot, clock, Link.local(robot.dof, history_slots(robot)))
        make = partial(open_backend, backend) if isinstance(backend, str) else backend
        self._rig = make(robot, clock, channel)
        self.frames = FrameRing.local(frame_slots(robot)) if backend == "can" else None
        self.loop = Loop(robot, self._rig, clock, self.link, reset, self.frames)
        self._next_ns = 0

    def open(self) -> None:
        self.loop.bring_up()
        self.loop.tick()
        self._next_ns = self.clock.now_ns() + self.robot.period_ns

    def advance(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds * self.robot.profile.servo_hz))):
            self.clock.sleep_until(self._next_ns)
            self._next_ns += self.robot.period_ns
            if not self.loop.closed:
                self.loop.tick()
        self.poll()

    def close(self) -> None:
        if not self.loop.closed:
            self.poll()
            self.loop.shut_down()

    def bus_statistics(self) -> dict[str, object] | None:
        return self._rig.arm.bus_statistics()
