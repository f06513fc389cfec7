"""The supervisor on synthetic samples: what stops the arm, what clears by itself, what stays latched."""

import itertools

import numpy as np
import pytest

from robotctl.hal.robot import load_robot
from robotctl.hal.types import Fault, Sample
from robotctl.safety.deadman import Grip
from robotctl.safety.machine import ENABLED, Event, Refused, State
from robotctl.safety.proximity import Scene
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.target import Hold, JointVelocity
from robotctl.safety.trip import Category, Protection, Trip

ROBOT = load_robot("panda")
SAFETY = ROBOT.profile.safety
HOME = np.array(ROBOT.profile.home)
REST = np.zeros(7)
CENTRE = np.array(ROBOT.profile.sphere.centre)
MS = 1_000_000
PERIOD = ROBOT.period_ns
PATHS = {
    State.OFF: (),
    State.SILENT: (Event.CONNECT,),
    State.READY: (Event.CONNECT, Event.SELFTEST),
    State.ARMED: (Event.CONNECT, Event.SELFTEST, Event.ARM),
    State.RUN: (Event.CONNECT, Event.SELFTEST, Event.ARM, Event.START),
    State.RESET: (Event.CONNECT, Event.SELFTEST, Event.ARM, Event.RESET),
    State.STOPPING: (Event.CONNECT, Event.SELFTEST, Event.ARM, Event.START, Event.STOP),
    State.HOLD: (Event.CONNECT, Event.SELFTEST, Event.ARM, Event.START, Event.STOP, Event.STANDSTILL_HOLD),
}
MOVING = (State.ARMED, State.RUN, State.RESET)


class Bench:
    """A supervisor, and the samples and time it is shown."""

    def __init__(self, state: State, scene: Scene | None = None) -> None:
        self.supervisor = Supervisor(ROBOT, scene)
        for event in PATHS[state]:
            self.supervisor.handle(event)
        self.supervisor.admission.renew(0)
        self.now = 0
        self.seq = 0
        self.position = HOME.copy()
        self.velocity = np.zeros(7)
        self.reference = None
        self.led = None
        self.external = np.zeros(7)
        self.tool = CENTRE
        self.faults = ()
        self.enabled = True
        self.age_ns = np.zeros(7, np.int64)

    def observe(self, at_ns=None):
        self.now = self.now + PERIOD if at_ns is None else at_ns
        stamps = self.now - self.age_ns
        sample = Sample(
            self.now, self.position, self.velocity, np.zeros(7), stamps, faults=self.faults, enabled=self.enabled
        )
        reference = self.position if self.reference is None else self.reference
        velocity = self.velocity if self.led is None else self.led
        self.supervisor.observe(sample, self.tool, reference, velocity, self.external, self.now)
        return self.supervisor.state

    def observe_until(self, at_ns):
        while self.now + PERIOD <= at_ns:
            self.observe()

    def offer(self, epoch=None, values=None):
        self.seq += 1
        epoch = self.supervisor.epoch if epoch is None else epoch
        values = np.ones(7) if values is None else values
        self.supervisor.offer(JointVelocity(values, epoch, self.seq, self.now + 1000 * MS), self.now)


def a_trip(category, protection=Protection.ESTOP):
    return Trip(protection, category, f"test of category {int(category)}", 0)


# -- every state, every category ---------------------------------------------------------------------------------


@pytest.mark.parametrize("category", Category)
@pytest.mark.parametrize("state", PATHS)
def test_a_trip_in_every_state(state, category):
    supervisor = Bench(state).supervisor
    before = supervisor.epoch
    took = supervisor.trip(a_trip(category))
    stopped_softly = state in (State.STOPPING, State.HOLD)  # with category 2, by PATHS
    if state in ENABLED and not (stopped_softly and category is Category.BRAKE_HOLD):
        assert took
        assert supervisor.state is (State.DISABLED if category is Category.CUT else State.STOPPING)
        assert supervisor.category is category
        assert supervisor.epoch == before + 1
    elif state is State.READY and category is not Category.BRAKE_HOLD:
        assert took
        assert supervisor.state is State.FAULT
    else:
        assert not took
        assert supervisor.state is state
        assert supervisor.epoch == before
    assert [trip.category for trip in supervisor.trips] == ([category] if took else [])
    assert (supervisor.cause is not None) is took


@pytest.mark.parametrize(("first", "second"), list(itertools.product(Category, repeat=2)))
def test_of_two_trips_the_harder_counts(first, second):
    supervisor = Bench(State.RUN).supervisor
    assert supervisor.trip(a_trip(first, Protection.TRACKING))
    epoch = supervisor.epoch
    took = supervisor.trip(a_trip(second, Protection.ESTOP))
    assert took is (second < first and first is not Category.CUT)
    assert supervisor.category is min(first, second)
    assert supervisor.cause.protection is (Protection.ESTOP if took else Protection.TRACKING)
    assert supervisor.epoch == epoch + took
    assert len(supervisor.trips) == 1 + took


@pytest.mark.parametrize("protection", [Protection.POSITION, Protection.SPHERE])
def test_of_simultaneous_findings_the_harder_one_stops(protection):
    bench = Bench(State.RUN)
    bench.tool = CENTRE + np.array([0.0, 0.0, 2.0])  # category 2
    bench.reference = HOME + 1.0  # category 1
    if protection is Protection.POSITION:
        bench.position = np.array(ROBOT.limits.upper) + 0.1
    bench.observe()
    assert bench.supervisor.category is Category.BRAKE_OFF


def test_an_operators_softer_stop_does_not_soften_a_hard_one():
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_OFF))
    supervisor.handle(Event.STOP)
    assert supervisor.category is Category.BRAKE_OFF
    supervisor.handle(Event.DISARM)
    assert supervisor.category is Category.BRAKE_OFF


def test_a_stop_that_ended_cleanly_leaves_nothing_behind():
    supervisor = Bench(State.RUN).supervisor
    for event in (Event.DISARM, Event.STANDSTILL_OFF):
        supervisor.handle(event)
    before = supervisor.epoch
    supervisor.handle(Event.OFF_CLEAN)
    assert (supervisor.state, supervisor.category, supervisor.epoch) == (State.READY, None, before + 1)


def test_acknowledging_clears_the_cause():
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_HOLD))
    supervisor.handle(Event.STANDSTILL_HOLD)
    supervisor.handle(Event.ACK)
    assert (supervisor.category, supervisor.cause) == (None, None)


# -- epochs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "event"),
    [
        (State.READY, Event.ARM),
        (State.RUN, Event.STOP),
        (State.RESET, Event.STOP),
        (State.ARMED, Event.DISARM),
        (State.HOLD, Event.DISARM),
        (State.HOLD, Event.ACK),
        (State.RESET, Event.RESET_DONE),
    ],
)
def test_every_stop_and_every_entry_into_armed_raises_the_epoch(state, event):
    supervisor = Bench(state).supervisor
    before = supervisor.epoch
    supervisor.handle(event)
    assert supervisor.epoch == before + 1


def test_the_first_epoch_is_0():
    assert Supervisor(ROBOT).epoch == 0
    assert not Supervisor(ROBOT).runs_away


def test_starting_keeps_the_epoch_so_that_a_policy_may_be_ready_first():
    supervisor = Bench(State.ARMED).supervisor
    before = supervisor.epoch
    supervisor.handle(Event.START)
    assert supervisor.epoch == before


def test_a_target_of_before_a_stop_never_runs_after_it():
    bench = Bench(State.RUN)
    old = bench.supervisor.epoch
    bench.offer()
    assert bench.supervisor.admitted(bench.now) is not None
    for event in (Event.STOP, Event.STANDSTILL_HOLD, Event.ACK, Event.START):
        bench.supervisor.handle(event)
        bench.offer(epoch=old)
    bench.supervisor.admission.renew(bench.now)
    assert bench.supervisor.admitted(bench.now) is None
    refused = bench.supervisor.admission.refused
    bench.offer(epoch=old)
    assert bench.supervisor.admission.refused == refused + 1
    bench.offer()
    assert bench.supervisor.admitted(bench.now) is not None


@pytest.mark.parametrize("state", [s for s in PATHS if s not in (State.RUN, State.STOPPING, State.HOLD)])
def test_nobody_listens_to_a_policy_that_was_not_started(state):
    bench = Bench(state)
    bench.offer(values=np.full(7, np.nan))
    assert bench.supervisor.state is state
    assert bench.supervisor.trips == []
    bench.offer()
    assert bench.supervisor.admission.seq == -1


@pytest.mark.parametrize("state", [s for s in PATHS if s is not State.RUN])
def test_a_target_moves_the_arm_in_run_only(state):
    bench = Bench(state)
    bench.offer()
    assert bench.supervisor.admitted(bench.now) is None


def test_hold_is_admitted_as_no_motion():
    bench = Bench(State.RUN)
    bench.supervisor.offer(Hold(bench.supervisor.epoch, 1, 1000 * MS), 0)
    assert bench.supervisor.admitted(0) is None
    assert bench.observe(99 * MS) is State.RUN


# -- P3, P5, P12, P17, P24 -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [s for s in PATHS if s not in ENABLED])
def test_with_the_drives_off_nothing_is_judged(state):
    bench = Bench(state)
    bench.position = np.array(ROBOT.limits.upper) + 1.0
    bench.enabled = False
    assert bench.observe() is state
    assert bench.supervisor.trips == []


@pytest.mark.parametrize("state", ENABLED)
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("joint", range(7))
def test_p3_position(state, side, joint):
    limit = (ROBOT.limits.upper if side > 0 else ROBOT.limits.lower)[joint]
    for beyond, trips in ((SAFETY.position_breach - 1e-6, False), (SAFETY.position_breach + 1e-6, True)):
        bench = Bench(state)
        bench.position[joint] = limit + side * beyond
        bench.observe(MS)
        assert bool(bench.supervisor.trips) is trips
        if trips:
            trip = bench.supervisor.trips[0]
            assert (trip.protection, trip.category) == (Protection.POSITION, Category.BRAKE_OFF)
            assert ROBOT.profile.joints[joint].name in trip.cause


@pytest.mark.parametrize("state", MOVING)
def test_p5_sphere(state):
    direction = np.array([0.6, 0.0, 0.8])
    reach = ROBOT.profile.sphere.radius + SAFETY.sphere_breach
    for distance, trips in ((reach - 1e-6, False), (reach + 1e-6, True)):
        bench = Bench(state)
        bench.tool = CENTRE + distance * direction
        bench.observe(MS)
        found = [(trip.protection, trip.category) for trip in bench.supervisor.trips]
        assert found == ([(Protection.SPHERE, Category.BRAKE_HOLD)] if trips else [])


@pytest.mark.parametrize("state", ENABLED)
@pytest.mark.parametrize("joint", range(7))
def test_p12_feedback(state, joint):
    oldest = round(SAFETY.feedback_fault_s * 1e9)
    for age, trips in ((oldest, False), (oldest + 1, True)):
        bench = Bench(state)
        bench.age_ns[joint] = age
        bench.observe(80 * MS)
        found = [(trip.protection, trip.category) for trip in bench.supervisor.trips]
        assert found == ([(Protection.FEEDBACK, Category.BRAKE_OFF)] if trips else [])
        if trips:
            assert bench.supervisor.trips[0].onset_ns == bench.now - 1
            assert ROBOT.profile.joints[joint].name in bench.supervisor.trips[0].cause


def test_stale_feedback_takes_the_target_away_and_gives_it_back():
    bench = Bench(State.RUN)
    bench.offer()
    limit = round(SAFETY.feedback_stop_s * 1e9)
    for age, admitted in ((limit, True), (limit + 1, False), (0, True)):
        bench.age_ns[3] = age
        bench.observe()
        assert (bench.supervisor.admitted(bench.now) is not None) is admitted
        assert bench.supervisor.state is State.RUN


@pytest.mark.parametrize("state", ENABLED)
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("joint", range(7))
def test_p17_tracking(state, side, joint):
    for error, trips in ((SAFETY.tracking_error - 1e-9, False), (SAFETY.tracking_error + 1e-9, True)):
        bench = Bench(state)
        bench.reference = HOME.copy()
        bench.reference[joint] += side * error
        bench.observe(MS)
        found = [(trip.protection, trip.category) for trip in bench.supervisor.trips]
        assert found == ([(Protection.TRACKING, Category.BRAKE_OFF)] if trips else [])


@pytest.mark.parametrize("state", ENABLED)
def test_p24_a_faulty_drive(state):
    bench = Bench(state)
    bench.faults = (Fault("panda_joint3", 0xB, "OVER_TEMPERATURE", "let it cool down"),)
    bench.observe()
    (trip,) = bench.supervisor.trips
    assert (trip.protection, trip.category) == (Protection.DRIVE, Category.BRAKE_OFF)
    assert "panda_joint3" in trip.cause
    assert "OVER_TEMPERATURE" in trip.cause
    assert "let it cool down" in trip.cause


@pytest.mark.parametrize("state", ENABLED)
def test_p24_a_drive_that_went_off(state):
    bench = Bench(state)
    bench.enabled = False
    bench.observe()
    assert [trip.protection for trip in bench.supervisor.trips] == [Protection.DRIVE]


def test_a_position_that_is_not_a_number_does_not_pass_for_healthy():
    bench = Bench(State.RUN)
    bench.position[2] = np.nan
    bench.age_ns[2] = 10**12  # what a joint that was never heard of looks like
    bench.observe()
    assert bench.supervisor.cause.protection is Protection.FEEDBACK


# -- standstill ----------------------------------------------------------------------------------------------------


def test_standstill_takes_five_quiet_ticks_in_a_row():
    bench = Bench(State.STOPPING)
    bench.led = np.zeros(7)
    for quiet in (4, 4, 5):
        bench.velocity[:] = SAFETY.standstill + 1e-6
        assert bench.observe() is State.STOPPING
        bench.velocity[:] = SAFETY.standstill - 1e-6
        for _ in range(quiet - 1):
            assert bench.observe() is State.STOPPING
        state = bench.observe()
        assert state is (State.HOLD if quiet == 5 else State.STOPPING)


def test_the_quiet_ticks_are_counted_anew_for_every_stop():
    bench = Bench(State.STOPPING)
    for _ in range(5):
        bench.observe()
    for event in (Event.ACK, Event.START, Event.STOP):
        bench.supervisor.handle(event)
    for _ in range(4):
        assert bench.observe() is State.STOPPING
    assert bench.observe() is State.HOLD


def test_one_joint_that_moves_is_not_standstill():
    bench = Bench(State.STOPPING)
    bench.led = np.zeros(7)
    bench.velocity[6] = -SAFETY.standstill
    for _ in range(20):
        assert bench.observe() is State.STOPPING


@pytest.mark.parametrize(("led", "rests"), [(1.1e-6, False), (-1.1e-6, False), (0.9e-6, True), (0.0, True)])
def test_an_arm_that_is_still_led_does_not_stand(led, rests):
    bench = Bench(State.STOPPING)
    bench.led = np.zeros(7)
    bench.led[2] = led
    for _ in range(5):
        bench.observe()
    assert (bench.supervisor.state is State.HOLD) is rests


def test_a_harder_stop_waits_for_a_standstill_of_its_own():
    bench = Bench(State.STOPPING)
    for _ in range(4):
        bench.observe()
    bench.supervisor.trip(a_trip(Category.BRAKE_OFF))
    for _ in range(4):
        assert bench.observe() is State.STOPPING
    assert bench.observe() is State.DISABLED


@pytest.mark.parametrize(
    ("category", "state"), [(Category.BRAKE_HOLD, State.HOLD), (Category.BRAKE_OFF, State.DISABLED)]
)
def test_a_stop_that_never_comes_to_rest_ends_anyway(category, state):
    bench = Bench(State.RUN)
    bench.velocity[:] = 1.0
    bench.supervisor.trip(a_trip(category))
    limit = round((ROBOT.stopping_time_s + 0.5) * 1e9)
    bench.observe()
    began = bench.now
    assert bench.observe(began + limit) is State.STOPPING
    assert bench.observe(began + limit + 1) is state


def test_the_time_a_stop_may_take_begins_anew_with_the_next_stop():
    bench = Bench(State.STOPPING)
    bench.velocity[:] = 1.0
    bench.observe_until(500 * MS)
    bench.velocity[:] = 0.0
    bench.observe_until(520 * MS)
    for event in (Event.ACK, Event.START):
        bench.supervisor.handle(event)
    bench.supervisor.admission.renew(bench.now)
    bench.observe_until(600 * MS)
    bench.velocity[:] = 1.0
    bench.supervisor.handle(Event.STOP)
    bench.observe_until(600 * MS + round((ROBOT.stopping_time_s + 0.4) * 1e9))
    assert bench.supervisor.state is State.STOPPING


# -- the heartbeat -------------------------------------------------------------------------------------------------


def silent_run():
    """A policy that fell silent at 0; the stop began at 100 ms."""
    bench = Bench(State.RUN)
    bench.observe_until(100 * MS - PERIOD)
    assert bench.supervisor.state is State.RUN
    bench.observe()
    assert bench.supervisor.state is State.STOPPING
    assert bench.supervisor.cause.protection is Protection.HEARTBEAT
    return bench


def test_a_heartbeat_back_within_the_grace_resumes_with_new_targets_only():
    bench = silent_run()
    bench.offer(epoch=bench.supervisor.epoch - 1)
    bench.observe_until(590 * MS)
    assert bench.supervisor.state is State.HOLD
    bench.offer()
    assert bench.observe() is State.RUN
    assert bench.supervisor.cause is None
    assert bench.supervisor.category is None
    assert bench.supervisor.admitted(bench.now) is not None
    assert len(bench.supervisor.trips) == 1


def test_a_heartbeat_that_is_back_while_the_arm_still_brakes_resumes_at_once():
    bench = silent_run()
    bench.velocity[:] = 0.5
    bench.offer()
    assert bench.observe() is State.RUN


@pytest.mark.parametrize(("at_ms", "resumes"), [(600, True), (602, False), (2000, False)])
def test_the_grace_ends_500_ms_after_the_heartbeat_was_missed(at_ms, resumes):
    bench = silent_run()
    bench.observe_until(at_ms * MS - PERIOD)
    bench.offer()
    bench.observe()
    assert bench.supervisor.state is (State.RUN if resumes else State.HOLD)


def test_after_the_grace_only_the_operator_resumes():
    bench = silent_run()
    bench.observe_until(700 * MS)
    for _ in range(20):
        bench.offer()
        assert bench.observe() is State.HOLD
    bench.supervisor.handle(Event.ACK)
    assert bench.supervisor.state is State.ARMED
    assert not bench.supervisor.recovery
    bench.supervisor.handle(Event.START)


@pytest.mark.parametrize(
    ("event", "end"), [(Event.STOP, State.HOLD), (Event.DISARM, State.DISABLED)], ids=["stop", "disarm"]
)
@pytest.mark.parametrize("wait_ms", [102, 300], ids=["stopping", "holding"])
def test_an_operators_stop_is_not_undone_by_the_heartbeats_return(event, end, wait_ms):
    bench = silent_run()
    bench.observe_until(wait_ms * MS)
    bench.supervisor.handle(event)
    for _ in range(20):
        bench.offer()
        bench.observe()
        if bench.supervisor.state is end:
            break
        assert bench.supervisor.state is not State.RUN
    assert bench.supervisor.state is end


def test_a_harder_stop_is_not_undone_by_the_heartbeats_return():
    bench = silent_run()
    bench.supervisor.trip(a_trip(Category.BRAKE_OFF))
    bench.offer()
    bench.observe_until(200 * MS)
    assert bench.supervisor.state is State.DISABLED


@pytest.mark.parametrize("state", [State.ARMED, State.RESET])
def test_no_policy_is_missed_before_it_was_started(state):
    bench = Bench(state)
    bench.observe_until(1000 * MS)
    assert bench.supervisor.state is state
    assert bench.supervisor.trips == []


def test_a_malformed_target_stops_at_once_and_three_end_in_a_fault():
    bench = Bench(State.RUN)
    bench.offer(values=np.full(7, np.nan))
    assert (bench.supervisor.state, bench.supervisor.category) == (State.STOPPING, Category.BRAKE_HOLD)
    bench.offer(values=np.full(7, np.nan))
    bench.offer()  # a good one does not clear it
    bench.observe()
    assert (bench.supervisor.state, bench.supervisor.category) == (State.STOPPING, Category.BRAKE_HOLD)
    bench.offer(values=np.zeros(6))
    assert (bench.supervisor.state, bench.supervisor.category) == (State.STOPPING, Category.BRAKE_OFF)
    assert bench.supervisor.cause.protection is Protection.MALFORMED


# -- recovery ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("protection", "recovers"),
    [(p, p in (Protection.POSITION, Protection.SPHERE, Protection.PROXIMITY)) for p in Protection],
    ids=[p.name for p in Protection],
)
def test_acknowledging_a_breach_permits_only_the_retreat(protection, recovers):
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_HOLD, protection))
    supervisor.handle(Event.STANDSTILL_HOLD)
    supervisor.handle(Event.ACK)
    assert supervisor.recovery is recovers
    supervisor.handle(Event.RESET)
    assert supervisor.recovery is recovers
    supervisor.handle(Event.RESET_DONE)
    assert not supervisor.recovery


def test_recovery_survives_the_way_through_a_fault():
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_OFF, Protection.POSITION))
    for event in (Event.STANDSTILL_OFF, Event.OFF_FAULT, Event.ACK, Event.SELFTEST, Event.ARM):
        supervisor.handle(event)
    assert supervisor.recovery


def test_in_recovery_the_breach_itself_does_not_trip_again_but_everything_else_does():
    bench = Bench(State.RESET)
    bench.supervisor.recovery = True
    bench.tool = CENTRE + np.array([0.0, 0.0, 2.0])
    bench.position[0] = ROBOT.limits.upper[0] + 0.5
    assert bench.observe() is State.RESET
    bench.reference = bench.position + 1.0
    assert bench.observe() is State.STOPPING


@pytest.mark.parametrize(
    ("beyond", "tool_out", "recovers"),
    [(-1e-9, -1e-9, False), (1e-9, -1e-9, True), (-1e-9, 1e-9, True)],
)
def test_arming_outside_a_limit_begins_the_recovery(beyond, tool_out, recovers):
    bench = Bench(State.ARMED)
    position = HOME.copy()
    position[1] = ROBOT.limits.lower[1] - beyond
    tool = CENTRE + np.array([ROBOT.profile.sphere.radius + tool_out, 0.0, 0.0])
    none = np.zeros(7)
    bench.supervisor.begin_recovery_if_outside(Sample(0, position, none, none, np.zeros(7, np.int64)), tool)
    assert bench.supervisor.recovery is recovers


def test_an_arm_is_not_stopped_for_what_did_not_leave_before_it_was_armed():
    bench = Bench(State.READY)
    for _ in range(5):
        bench.supervisor.bus.sent(delivered=False)
    bench.supervisor.handle(Event.ARM)
    assert bench.observe() is State.ARMED


@pytest.mark.parametrize("state", [State.READY, State.STOPPING])
def test_a_joint_that_stays_too_fast_for_100_ms_runs_away(state):
    bench = Bench(state)
    bench.observe()
    bench.velocity[2] = -1.21 * ROBOT.limits.velocity[2]
    bench.led = bench.velocity
    # Three samples to be sure that it is too fast.
    bench.observe_until(bench.now + 100 * MS + 2 * PERIOD)
    assert not bench.supervisor.runs_away
    bench.observe()
    assert bench.supervisor.runs_away
    bench.velocity[2] = 0.0
    bench.observe()
    assert not bench.supervisor.runs_away


def test_a_refused_event_changes_nothing():
    supervisor = Bench(State.READY).supervisor
    before = supervisor.epoch
    with pytest.raises(Refused):
        supervisor.handle(Event.START)
    assert (supervisor.state, supervisor.epoch) == (State.READY, before)


@pytest.mark.parametrize("at", [State.STOPPING, State.DISABLED])
def test_an_emergency_stop_latches_while_the_operator_disarms(at):
    supervisor = Bench(State.RUN).supervisor
    supervisor.handle(Event.DISARM)
    if at is State.DISABLED:
        supervisor.handle(Event.STANDSTILL_OFF)
    assert supervisor.trip(a_trip(Category.BRAKE_OFF, Protection.ESTOP))
    assert supervisor.state is at
    assert supervisor.cause.protection is Protection.ESTOP
    assert not supervisor.trip(a_trip(Category.BRAKE_OFF, Protection.ESTOP))
    assert len(supervisor.trips) == 1


def test_the_age_of_feedback_is_known_with_the_drives_off_too():
    bench = Bench(State.READY)
    for age_ms, stale, lost in ((5, False, False), (20, True, False), (60, True, True), (0, False, False)):
        bench.age_ns[3] = age_ms * MS
        bench.observe()
        assert (bench.supervisor.feedback.stale, bench.supervisor.feedback.lost) == (stale, lost)
    assert bench.supervisor.trips == []


# -- what an event needs besides the right state -------------------------------------------------------------------


@pytest.mark.parametrize("protection", Protection, ids=[p.name for p in Protection])
def test_start_acknowledges_a_stop_only_where_the_protection_allows_that(protection):
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_HOLD, protection))
    supervisor.handle(Event.STANDSTILL_HOLD)
    before = supervisor.epoch
    if protection in (Protection.MALFORMED, Protection.HEARTBEAT):
        assert supervisor.handle(Event.START) is State.RUN
        assert (supervisor.category, supervisor.cause) == (None, None)
    else:
        with pytest.raises(Refused, match=r"^START is refused in state HOLD: acknowledge first$"):
            supervisor.handle(Event.START)
        assert supervisor.state is State.HOLD
        assert supervisor.cause is not None
    assert supervisor.epoch == before


def test_start_does_not_acknowledge_an_operators_stop():
    supervisor = Bench(State.HOLD).supervisor
    with pytest.raises(Refused, match="acknowledge first"):
        supervisor.handle(Event.START)


def test_in_recovery_only_the_retreat_is_started():
    supervisor = Bench(State.ARMED).supervisor
    supervisor.recovery = True
    with pytest.raises(Refused, match="outside its limits; retreat first"):
        supervisor.handle(Event.START)
    assert supervisor.handle(Event.RESET) is State.RESET


@pytest.mark.parametrize("event", [Event.START, Event.RESET])
def test_nothing_is_started_while_the_deadmans_switch_is_not_held(event):
    supervisor = Bench(State.ARMED).supervisor
    supervisor.deadman.take(Grip.RELEASED, 0)
    with pytest.raises(Refused, match="the deadman's switch is not held"):
        supervisor.handle(event)
    supervisor.deadman.take(Grip.HELD, 0)
    supervisor.handle(event)


def test_arming_and_stopping_need_no_deadmans_switch():
    supervisor = Bench(State.READY).supervisor
    supervisor.deadman.take(Grip.RELEASED, 0)
    for event in (Event.ARM, Event.STOP, Event.DISARM):
        supervisor.handle(event)


def into_fault(bench, protection):
    bench.supervisor.trip(a_trip(Category.BRAKE_OFF, protection))
    for event in (Event.STANDSTILL_OFF, Event.OFF_FAULT):
        bench.supervisor.handle(event)


@pytest.mark.parametrize("protection", [Protection.DRIVE, Protection.FRAMES])
def test_a_failed_drive_is_acknowledged_after_its_power_was_off(protection):
    bench = Bench(State.RUN)
    bench.age_ns[:] = 60 * MS  # power that was off before the fault does not count
    bench.supervisor.feedback.check(Sample(0, HOME, REST, REST, -bench.age_ns), 0)
    bench.age_ns[:] = 0
    into_fault(bench, protection)
    bench.observe()
    for silent in ([3], range(6)):  # one drive is still heard of
        bench.age_ns[list(silent)] = 60 * MS
        bench.observe()
        with pytest.raises(Refused, match="switch the power of the drives off and on first"):
            bench.supervisor.handle(Event.ACK)
    bench.age_ns[:] = 60 * MS
    bench.observe()
    bench.age_ns[:] = 0
    bench.observe()
    assert bench.supervisor.handle(Event.ACK) is State.SILENT


def test_the_next_failure_takes_the_power_off_anew():
    bench = Bench(State.RUN)
    into_fault(bench, Protection.DRIVE)
    bench.age_ns[:] = 60 * MS
    bench.observe()
    bench.age_ns[:] = 0
    for event in (Event.ACK, Event.SELFTEST, Event.ARM):
        bench.supervisor.handle(event)
    into_fault(bench, Protection.DRIVE)
    with pytest.raises(Refused, match="switch the power"):
        bench.supervisor.handle(Event.ACK)


def test_a_stop_for_a_failed_drive_that_ends_in_hold_is_acknowledged_like_any_other():
    supervisor = Bench(State.RUN).supervisor
    supervisor.trip(a_trip(Category.BRAKE_HOLD, Protection.DRIVE))
    supervisor.handle(Event.STANDSTILL_HOLD)
    assert supervisor.handle(Event.ACK) is State.ARMED


def test_other_faults_are_acknowledged_with_the_power_on():
    bench = Bench(State.RUN)
    into_fault(bench, Protection.TRACKING)
    assert bench.supervisor.handle(Event.ACK) is State.SILENT


# -- the deadman's switch ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", PATHS)
def test_letting_go_of_the_deadmans_switch_stops_what_moves(state):
    bench = Bench(state)
    bench.supervisor.deadman.take(Grip.RELEASED, 0)
    bench.observe()
    found = [(trip.protection, trip.category) for trip in bench.supervisor.trips]
    assert found == ([(Protection.DEADMAN, Category.BRAKE_HOLD)] if state in (State.RUN, State.RESET) else [])


def test_holding_the_deadmans_switch_again_goes_on_from_standstill_only():
    bench = Bench(State.RUN)
    bench.supervisor.deadman.take(Grip.RELEASED, 0)
    assert bench.observe() is State.STOPPING
    bench.supervisor.deadman.take(Grip.HELD, bench.now)
    assert bench.observe() is State.STOPPING
    bench.observe_until(bench.now + 5 * PERIOD)
    assert bench.supervisor.state is State.RUN
    assert bench.supervisor.cause is None
    # The policy, whose targets went by, has a heartbeat from now on.
    bench.observe_until(bench.now + 90 * MS)
    assert bench.supervisor.state is State.RUN
    bench.observe_until(bench.now + 20 * MS)
    assert bench.supervisor.cause.protection is Protection.HEARTBEAT


def test_as_long_as_the_deadmans_switch_is_let_go_the_arm_stays_at_rest():
    bench = Bench(State.RUN)
    bench.supervisor.deadman.take(Grip.RELEASED, 0)
    bench.observe_until(20 * MS)
    for _ in range(10):
        assert bench.observe() is State.HOLD
    assert len(bench.supervisor.trips) == 1


def test_a_deadmans_switch_that_is_held_again_does_not_undo_an_operators_stop():
    bench = Bench(State.RUN)
    bench.supervisor.deadman.take(Grip.RELEASED, 0)
    bench.observe()
    bench.supervisor.handle(Event.STOP)
    bench.supervisor.deadman.take(Grip.HELD, bench.now)
    bench.observe_until(100 * MS)
    assert bench.supervisor.state is State.HOLD


def test_a_reset_routine_does_not_go_on_by_itself():
    bench = Bench(State.RESET)
    bench.supervisor.deadman.take(Grip.RELEASED, 0)
    bench.observe()
    bench.supervisor.deadman.take(Grip.HELD, bench.now)
    bench.observe_until(100 * MS)
    assert bench.supervisor.state is State.HOLD


# -- what is believed ----------------------------------------------------------------------------------------------


def a_sample(stamp_ns, position):
    return Sample(stamp_ns, position, REST, REST, np.full(7, stamp_ns), enabled=True)


@pytest.mark.parametrize("state", PATHS)
def test_a_jump_is_believed_only_while_the_drives_are_off(state):
    supervisor = Bench(state).supervisor
    supervisor.screen(a_sample(0, HOME))
    jumped = supervisor.screen(a_sample(PERIOD, HOME + 1.0))
    assert (jumped.position == HOME).all() == (state in ENABLED)


def test_arming_begins_with_what_is_measured_then():
    supervisor = Bench(State.READY).supervisor
    supervisor.screen(a_sample(0, HOME))
    supervisor.handle(Event.ARM)
    assert (supervisor.screen(a_sample(PERIOD, HOME + 1.0)).position == HOME + 1.0).all()


def test_measurements_that_keep_jumping_stop_the_arm():
    bench = Bench(State.RUN)
    bench.supervisor.screen(a_sample(0, HOME))
    for number in range(1, SAFETY.rejected_frames + 1):
        assert bench.observe(number * PERIOD) is State.RUN
        bench.supervisor.screen(a_sample(number * PERIOD, HOME + 1.0))
    assert bench.observe() is State.STOPPING
    assert bench.supervisor.cause.protection is Protection.RECEIVE


# -- P14, P17 and P18 in their states ------------------------------------------------------------------------------


def test_commands_that_do_not_leave_the_host_stop_the_arm():
    bench = Bench(State.ARMED)
    for _ in range(5):
        assert bench.observe() is State.ARMED
        bench.supervisor.bus.sent(delivered=False)
    bench.observe()
    assert bench.supervisor.cause.protection is Protection.BUS


def test_an_arm_that_creeps_away_from_its_hold_is_cut_off():
    bench = Bench(State.HOLD)
    bench.observe()
    bench.position = HOME + SAFETY.standstill_drift + 1e-6
    assert bench.observe() is State.DISABLED
    assert bench.supervisor.cause.protection is Protection.TRACKING


def test_an_arm_that_is_armed_may_be_led_away():
    bench = Bench(State.RUN)
    bench.observe()
    bench.position = HOME + SAFETY.standstill_drift + 1e-6
    assert bench.observe() is State.RUN


def test_overspeed_is_judged_whatever_was_asked_for():
    bench = Bench(State.RUN)
    bench.led = bench.velocity = 1.3 * ROBOT.limits.velocity
    for _ in range(2):
        assert bench.observe() is State.RUN
    assert bench.observe() is State.STOPPING
    assert (bench.supervisor.cause.protection, bench.supervisor.category) == (Protection.OVERSPEED, Category.BRAKE_OFF)


@pytest.mark.parametrize("state", MOVING)
def test_the_tool_is_slow_during_resets_only(state):
    bench = Bench(state)
    bench.observe()
    bench.tool = CENTRE + np.array([0.0, 0.0, 0.02])  # 0.4 m/s over 50 ms
    bench.observe(bench.now + 50 * MS)
    assert [trip.protection for trip in bench.supervisor.trips] == (
        [Protection.OVERSPEED] if state is State.RESET else []
    )


# -- P20 -----------------------------------------------------------------------------------------------------------


class Crowded:
    """A scene with one pair, whose clearance is the first joint's position."""

    pairs = (("elbow", "table"),)
    reach = np.eye(1, 7)

    def measure(self, position, pairs):
        return position[:1]

    def approach(self, position, pairs):
        return [-np.eye(1, 7)[0] for _ in pairs]


@pytest.mark.parametrize("state", MOVING)
@pytest.mark.parametrize(("recovery", "trips"), [(False, True), (True, False)])
def test_links_that_are_too_near_stop_the_arm_unless_it_retreats(state, recovery, trips):
    bench = Bench(state, Crowded())
    bench.position[0] = SAFETY.proximity_stop + 1e-6
    bench.supervisor.recovery = recovery
    assert bench.observe() is state
    bench.position = bench.position - np.eye(1, 7)[0] * 2e-6
    bench.observe()
    found = [(trip.protection, trip.category) for trip in bench.supervisor.trips]
    assert found == ([(Protection.PROXIMITY, Category.BRAKE_HOLD)] if trips else [])


@pytest.mark.parametrize(("spare", "recovers"), [(1e-6, False), (-1e-6, True)])
def test_arming_with_links_too_near_begins_the_recovery(spare, recovers):
    supervisor = Bench(State.ARMED, Crowded()).supervisor
    position = HOME.copy()
    position[0] = SAFETY.proximity_stop + spare
    supervisor.begin_recovery_if_outside(a_sample(0, position), CENTRE)
    assert supervisor.recovery is recovers


# -- contact -------------------------------------------------------------------------------------------------------


def test_p19_an_arm_that_is_touched_stops_and_gives_way_without_being_judged_for_it():
    bench = Bench(State.RUN)
    bench.external[0] = 0.4 * ROBOT.limits.torque[0]
    for _ in range(11):
        bench.supervisor.admission.renew(bench.now)
        assert not bench.supervisor.yields
        bench.observe()
    assert [trip.protection for trip in bench.supervisor.trips] == [Protection.CONTACT]
    assert bench.supervisor.state is State.STOPPING
    assert bench.supervisor.yields
    bench.observe_until(bench.now + 200 * MS)
    assert bench.supervisor.state is State.HOLD
    bench.reference = bench.position.copy()
    bench.position = bench.position + 0.1  # as far as a tracking error and a creep would go
    bench.led = np.full(7, 2.0)
    for _ in range(50):
        bench.observe()
    assert len(bench.supervisor.trips) == 1
    bench.supervisor.handle(Event.ACK)
    assert not bench.supervisor.yields


def test_an_arm_that_stopped_for_something_else_does_not_give_way():
    bench = Bench(State.RUN)
    bench.supervisor.trip(a_trip(Category.BRAKE_HOLD, Protection.DEADMAN))
    assert not bench.supervisor.yields
