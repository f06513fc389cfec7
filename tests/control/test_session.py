"""Lockstep sessions: repeatable to the bit, and readable when they end early."""

import numpy as np
import pytest

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.errors import HardwareError
from robotctl.hal.robot import load_robot
from robotctl.learning.actor import InlineActor
from robotctl.learning.run import Outcome, run_episodes
from robotctl.learning.task import load_task
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity

NOISY = ["twin.noise_position=1e-4", "twin.noise_velocity=1e-3", "twin.lag_s=0.01", "twin.delay_s=0.004"]


def records_of(name, backend, policy, seed, overrides=()):
    task = load_task("reach").model_copy(update={"steps": 20})
    with LockstepSession(load_robot(name, list(overrides)), backend) as session:
        outcome = Outcome()
        run_episodes(session, InlineActor(session, task, policy, seed), task, 1, seed, outcome)
        records, _, dropped = session.link.ticks.since(0)
        assert dropped == 0
        assert len(records) == session.statistics.ticks > 500
        return records, outcome


@pytest.mark.parametrize("backend", ["sim", "can"])
@pytest.mark.parametrize("policy", ["scripted", "random"])
def test_the_same_seed_gives_the_same_records_to_the_bit(backend, policy):
    one, other = (records_of("panda", backend, policy, 5, NOISY) for _ in range(2))
    assert one[1] == other[1]
    for field in one[0].dtype.names:
        if field != "duration_ns":
            assert np.array_equal(one[0][field], other[0][field]), field


def test_another_seed_gives_others():
    one, other = (records_of("panda", "sim", "random", seed)[0] for seed in (5, 6))
    assert not np.array_equal(one["wanted"][: len(other)], other["wanted"][: len(one)])


@pytest.fixture
def session(panda):
    with LockstepSession(panda, "sim") as made:
        yield made


def test_open_ends_in_ready(session):
    assert session.state is State.READY
    assert session.bus_statistics() is None


def test_before_it_is_open_there_is_nothing_to_see(panda):
    with pytest.raises(HardwareError, match="has not made a tick"):
        LockstepSession(panda, "sim").latest()


def test_a_refused_request_says_why(session):
    with pytest.raises(Stopped, match="START is refused in state READY"):
        session.request(Verb.START)
    assert session.state is State.READY


def test_waiting_for_a_state_names_the_trip_that_came_between(session):
    session.request(Verb.ARM)
    session.begin()
    record = session.latest()
    bad = np.full(7, np.nan)
    session.link.mailbox.put(JointVelocity(bad, int(record["epoch"]), 0, session.clock.now_ns() + 10**8))
    with pytest.raises(Stopped) as caught:
        session.wait_for(State.ARMED, timeout_s=5.0)
    assert "expected ARMED, but the supervisor is in HOLD" in str(caught.value)
    assert "policy sent a malformed target: value 0 is not finite" in str(caught.value)


def test_waiting_in_vain_ends_in_time(session):
    session.request(Verb.ARM)
    before = session.clock.now_ns()
    with pytest.raises(HardwareError, match=r"state RUN not reached within 0\.5 s"):
        session.wait_for(State.RUN, timeout_s=0.5)
    assert session.clock.now_ns() - before == pytest.approx(0.5e9, abs=0.02e9)


def test_an_emergency_stop_needs_no_answer(session):
    session.request(Verb.ARM)
    session.emergency_stop()
    session.advance(0.002)
    with pytest.raises(Stopped, match="emergency stop by the operator"):
        session.wait_for(State.ARMED, State.RUN, timeout_s=2.0)
    assert session.state is State.FAULT
    assert [trip["protection"] for trip in session.trips] == ["P23"]


@pytest.mark.parametrize("verb", [Verb.DISARM, Verb.ESTOP])
def test_bringing_to_rest_works_from_anywhere(session, verb):
    session.bring_to_rest(verb)
    assert session.state is State.READY
    session.request(Verb.ARM)
    session.begin()
    session.bring_to_rest(verb)
    assert session.state is (State.READY if verb is Verb.DISARM else State.FAULT)
    session.bring_to_rest(verb)


def test_prepare_and_finish_frame_a_run(session):
    session.prepare()
    assert session.state is State.ARMED
    session.begin()
    assert session.state is State.RUN
    session.end()
    assert session.state is State.ARMED
    session.finish()
    assert session.state is State.READY
    assert session.trips == []


def test_prepare_retreats_first_where_the_arm_stands_outside(panda):
    with LockstepSession(panda, "sim") as session:
        outside = np.array(panda.profile.home)
        outside[4] = panda.limits.upper[4] + 0.05
        session._rig.arm._plant.place(outside)
        session.prepare()
        assert session.state is State.ARMED
        assert session.latest()["true_position"] == pytest.approx(np.array(panda.profile.home), abs=5e-3)
        assert session.trips == []
        assert sum(session.judge.violations.values()) == 0


def test_events_trips_and_polls_are_passed_on(session):
    events, trips, polls = [], [], []
    session.on_event, session.on_trip, session.on_poll = events.append, trips.append, lambda: polls.append(1)
    session.request(Verb.ARM)
    session.emergency_stop()
    session.advance(1.0)
    assert [event["type"] for event in events].count("trip") == 1
    assert trips == session.trips
    assert {event["type"] for event in events} == {"state", "answer", "trip"}
    assert polls


def test_closing_twice_is_harmless(panda):
    session = LockstepSession(panda, "sim")
    session.open()
    session.request(Verb.ARM)
    session.close()
    session.close()
    assert session.loop.closed
    assert not session._rig.arm._enabled


def test_a_whole_life_is_seen_by_judge_and_statistics(session):
    session.prepare()
    session.finish()
    assert session.statistics.ticks == session.link.ticks.head
    assert session.statistics.report()["servo_hz"] == pytest.approx(500.0)
    assert session.judge.judged > 0
    assert session.judge.on_truth


def test_ending_an_episode_does_not_acknowledge_what_stopped_the_arm_meanwhile(session):
    session.prepare()
    session.begin()
    session.advance(0.02)
    bad = JointVelocity(np.full(7, np.nan), int(session.latest()["epoch"]), 0, session.clock.now_ns() + 10**8)
    session.link.mailbox.put(bad)
    session.loop.tick()  # which the operator's side has not looked at yet
    with pytest.raises(Stopped, match="malformed target"):
        session.end()
    assert session.state is State.HOLD


def test_an_emergency_stop_survives_whatever_is_asked_in_the_same_tick(session):
    session.request(Verb.ARM)
    session.emergency_stop()
    with pytest.raises(Stopped, match="START is refused in state STOPPING"):
        session.begin()
    session.bring_to_rest(Verb.DISARM)
    assert session.state is State.FAULT


def test_a_request_is_answered_though_an_emergency_stop_came_in_between(session):
    session.request(Verb.ARM)
    session.on_poll = session.emergency_stop
    with pytest.raises(Stopped, match="START is refused"):
        session.begin()


def test_winding_down_ends_at_rest_whatever_happens_meanwhile():
    with LockstepSession(load_robot("openarm"), "sim") as session:
        session.prepare()
        session.begin()
        session.advance(0.02)
        session.loop.estop("a test")
        session.wind_down()
        assert session.state is State.FAULT
