"""The supervisor: what state the arm is in, what is let through, and what stops it.

One object for twin and hardware. It reads no clock and does no I/O: samples, targets, requests and the time come in;
states, trips and admitted targets go out.
"""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.admission import Admission
from robotctl.safety.believable import Believable
from robotctl.safety.contact import ContactReflex
from robotctl.safety.deadman import Deadman
from robotctl.safety.drives import BusHealth, DriveHealth
from robotctl.safety.machine import ENABLED, Event, Refused, State, after
from robotctl.safety.protections import FeedbackAge, PositionBreach, SphereBreach
from robotctl.safety.proximity import NothingNear, ProximityBreach, Scene
from robotctl.safety.target import Hold, Target
from robotctl.safety.tracking import Drift, Overspeed, ToolSpeed, TrackingError
from robotctl.safety.trip import Category, Clearing, Protection, Trip

_TRIP_EVENTS = {
    Category.BRAKE_HOLD: Event.TRIP_HOLD,
    Category.BRAKE_OFF: Event.TRIP_OFF,
    Category.CUT: Event.TRIP_CUT,
}
_RECOVERABLE = (Protection.POSITION, Protection.SPHERE, Protection.PROXIMITY)
"""After these, acknowledging permits nothing but the retreat."""
_STANDSTILL_TICKS = 5
_LED = 1e-6
"""Speed below which nothing is led any more, rad/s."""
_RUNAWAY_NS = 100_000_000
"""Longest time for which a damped joint may be too fast."""
_STOP_ALLOWANCE_S = 0.5


class Supervisor:
    """State machine, protections and admission of one arm."""

    def __init__(self, robot: Robot, scene: Scene | None = None) -> None:
        safety = robot.profile.safety
        self.state = State.OFF
        self.epoch = 0
        """Raised by every stop and every entry to ARMED; targets of an older epoch are dropped."""
        self.category: Category | None = None
        """Of the stop in progress or in force."""
        self.cause: Trip | None = None
        """The trip that is latched, if the arm was not stopped by its operator."""
        self.recovery = False
        """Whether only the retreat routine may move the arm."""
        self.trips: list[Trip] = []
        """Every trip of this supervisor's life, oldest first."""
        self.admission = Admission(robot)
        self.feedback = FeedbackAge(robot)
        self.deadman = Deadman(robot)
        self.bus = BusHealth()
        self.drives = DriveHealth(robot)
        self.contact = ContactReflex(robot)
        self._believable = Believable(robot)
        self._position = PositionBreach(robot)
        self._sphere = SphereBreach(robot)
        self._proximity = ProximityBreach(robot, scene or NothingNear(robot.dof))
        self._tracking = TrackingError(robot)
        self._drift = Drift(robot)
        self._overspeed = Overspeed(robot)
        self._tool_speed = ToolSpeed(robot)
        self._standstill = safety.standstill
        self._grace_ns = round(safety.heartbeat_grace_s * 1e9)
        self._stopping_limit_ns = round((robot.stopping_time_s + _STOP_ALLOWANCE_S) * 1e9)
        self._stopping_since_ns: int | None = None
        # Set by every change of state, every stop, every trip, and in every tick: they need no first value.
        self._settled: int
        self._was_running: bool
        self._power_cycled: bool
        self._fast_since_ns: int
        self.runs_away = False
        """Whether a joint goes on too fast although it should have been stopped: damping does not help."""

    # -- what happens to it ---------------------------------------------------------------------------------------

    def handle(self, event: Event) -> State:
        """Take one event.

        Raises:
            Refused: if the present state does not allow it.
        """
        before, following = self.state, after(self.state, event)
        why = self._objection(event)
        if why:
            raise Refused(before, event, why)
        self.state = following
        match event:
            case Event.STOP | Event.DISARM:
                category = Category.BRAKE_HOLD if event is Event.STOP else Category.BRAKE_OFF
                self._raise_epoch(category if self.category is None else min(category, self.category))
                self._was_running = False  # a heartbeat that comes back does not undo what the operator did
            case Event.ARM | Event.ACK | Event.RESET_DONE | Event.OFF_CLEAN:
                self._raise_epoch(None)
                if event is Event.ARM:
                    self._believable.forget()
                    self.bus.forget()
                elif event is Event.ACK:
                    self.recovery = self.cause is not None and self.cause.protection in _RECOVERABLE
                elif event is Event.RESET_DONE:
                    self.recovery = False
                self.cause = None
            case Event.CLEARED | Event.START:
                self.category = None
                self.cause = None
        if before is not self.state:
            self._settled = 0
        return self.state

    def trip(self, trip: Trip) -> bool:
        """Stop the arm for `trip`; one that is no harder than the trip in force changes nothing.

        One as hard as a stop that the operator asked for gives that a cause, so that it latches. Returns whether the
        trip took effect.
        """
        event = _TRIP_EVENTS[trip.category]
        harder = (
            self.category is None
            or trip.category < self.category
            or self.cause is None  # the operator's: of a softer trip none gets past the states
        )
        if self.state in ENABLED and harder and not (event is Event.TRIP_HOLD and self.state not in _SOFT_TRIPPABLE):
            self._was_running = self.state is State.RUN
            self.state = after(self.state, event)
            self._raise_epoch(trip.category)
            self._settled = 0
        elif self.state is State.READY and trip.category is not Category.BRAKE_HOLD:
            self.state = after(self.state, event)
        elif self.state is State.DISABLED and self.cause is None:
            pass  # the drives are going off already; with a cause they end in FAULT
        else:
            return False
        self._power_cycled = False
        self.cause = trip
        self.trips.append(trip)
        return True

    # -- asked in every tick --------------------------------------------------------------------------------------

    def screen(self, sample: Sample) -> Sample:
        """Return what can be believed of a sample. Comes before everything else that looks at it."""
        if self.state in _AT_REST:
            self._believable.forget()
        return self._believable.screen(sample)

    def observe(
        self, sample: Sample, tool: Vector, position: Vector, velocity: Vector, external: Vector, now_ns: int
    ) -> None:
        """Judge a sample: trips, standstill, automatic clearing.

        Args:
            sample: what `screen` left of it.
            tool: measured tool point (3,), m.
            position: where the drives are led (n,), rad.
            velocity: how they are led (n,), rad/s.
            external: torque that acts beside the drives (n,), Nm.
            now_ns: the present time.
        """
        silent = self.feedback.check(sample, now_ns)  # in every state: an arm is damped with the drives on, too
        if self.feedback.dead:
            self._power_cycled = True
        fast = self._overspeed.check(sample)
        if fast is None:
            self._fast_since_ns = now_ns
        self.runs_away = now_ns - self._fast_since_ns > _RUNAWAY_NS
        if self.state not in ENABLED:
            return
        trips = [
            silent,
            self.bus.check(sample),
            self._believable.check(now_ns),
            self.drives.check(sample),
            self.contact.check(external, sample.stamp_ns),
            fast,
            self._tool_speed.check(tool, sample.stamp_ns, slow=self.state is State.RESET),
        ]
        if not self.yields:
            trips.append(self._tracking.check(sample, position, velocity))
            trips.append(self._drift.check(sample, holding=self.state is State.HOLD))
        if not self.recovery:
            near = self._proximity.check(sample.position, sample.stamp_ns)
            trips += [self._position.check(sample), self._sphere.check(tool, sample.stamp_ns), near]
        if self.state in _MOVING:
            trips.append(self.deadman.check(now_ns))
        if self.state is State.RUN:
            trips.append(self.admission.heartbeat(now_ns))
        found = [trip for trip in trips if trip is not None]
        if found:
            self.trip(min(found, key=lambda trip: trip.category))
        if self.state is State.STOPPING:
            self._watch_standstill(sample, velocity, now_ns)
        else:
            self._stopping_since_ns = None
        if self.state in (State.STOPPING, State.HOLD) and self._was_running:
            self._clear(now_ns)

    def begin_recovery_if_outside(self, sample: Sample, tool: Vector) -> None:
        """When armed outside its limits or regions, or too near to something, the arm may do nothing but retreat."""
        outside = not self._position.inside(sample.position) or self._sphere.outside(tool) > 0.0
        if outside or self._proximity.check(sample.position, sample.stamp_ns) is not None:
            self.recovery = True

    @property
    def yields(self) -> bool:
        """Whether the arm stopped for a contact, so that it gives way rather than press on."""
        return self.cause is not None and self.cause.protection is Protection.CONTACT

    def stands(self, sample: Sample) -> bool:
        """Return whether every joint was measured at rest."""
        return bool((np.abs(sample.velocity) < self._standstill).all())

    def offer(self, target: Target, now_ns: int) -> None:
        """Take a new target from the mailbox; malformed ones stop the arm."""
        if self.state in _LISTENING:
            trip = self.admission.offer(target, self.epoch, now_ns)
            if trip is not None:
                self.trip(trip)

    def admitted(self, now_ns: int) -> Target | None:
        """Return the policy's target if it may move the arm now; None means brake and hold."""
        if self.state is not State.RUN or self.feedback.stale:
            return None
        target = self.admission.fresh(now_ns)
        return None if isinstance(target, Hold) else target

    # -- inside ---------------------------------------------------------------------------------------------------

    def _objection(self, event: Event) -> str:
        """Return why an event that the state allows is refused all the same."""
        clearing = self.cause.protection.clearing if self.cause else Clearing.ACK
        match event:
            case Event.START | Event.RESET if not self.deadman.permits:
                return "the deadman's switch is not held"
            case Event.START if self.recovery:
                return "the arm is outside its limits; retreat first"
            case Event.START if self.state is State.HOLD and clearing is not Clearing.START:
                return "acknowledge first"
            case Event.ACK if self.state is State.FAULT and clearing is Clearing.POWER and not self._power_cycled:
                return "switch the power of the drives off and on first"
        return ""

    def _raise_epoch(self, category: Category | None) -> None:
        self.epoch += 1
        self.category = category

    def _watch_standstill(self, sample: Sample, velocity: Vector, now_ns: int) -> None:
        if self._stopping_since_ns is None:
            self._stopping_since_ns = now_ns
        # Slow alone is not at rest: braking with bounded jerk may lead a joint back a little after it has stopped.
        at_rest = self.stands(sample) and bool((np.abs(velocity) < _LED).all())
        self._settled = self._settled + 1 if at_rest else 0
        # A joint that is not heard of, or that somebody shakes, must not keep a stop from ending.
        overdue = now_ns - self._stopping_since_ns > self._stopping_limit_ns
        if self._settled >= _STANDSTILL_TICKS or overdue:
            self.handle(Event.STANDSTILL_HOLD if self.category is Category.BRAKE_HOLD else Event.STANDSTILL_OFF)

    def _clear(self, now_ns: int) -> None:
        """Go on by itself: after a heartbeat that comes back in time, and when a deadman's switch is held again."""
        cause = self.cause
        assert cause is not None  # a trip out of RUN
        match cause.protection:
            case Protection.HEARTBEAT:
                if self.admission.fresh(now_ns) is not None and now_ns - cause.onset_ns <= self._grace_ns:
                    self.handle(Event.CLEARED)
            case Protection.DEADMAN if self.deadman.permits and self.state is State.HOLD:
                self.admission.renew(now_ns)
                self.handle(Event.CLEARED)


_AT_REST = (State.OFF, State.SILENT, State.READY)
"""Drives are off and may be moved or woken up a turn away; in DISABLED and FAULT they may still be damped."""
_SOFT_TRIPPABLE = (State.ARMED, State.RUN, State.RESET)
_MOVING = (State.RUN, State.RESET)
_LISTENING = (State.RUN, State.STOPPING, State.HOLD)
