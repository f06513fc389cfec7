"""The loop in lockstep: what it answers, what it sends, and how every stop ends."""

from collections.abc import Callable

import numpy as np
import pytest

from robotctl.control.loop import Loop
from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.control.shared import Link, Power
from robotctl.control.task_reset import PoseStep
from robotctl.hal.arm import Arm
from robotctl.hal.backend import Rig, open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import DriveError
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Command, CommandMode, Sample, Sent, Truth
from robotctl.safety.machine import ENABLED, State
from robotctl.safety.shaper import Clip
from robotctl.safety.target import FreeDrive, Hold, JointTorque, JointVelocity
from robotctl.safety.trip import Category
from robotctl.sim.motors.trouble import Mute, PowerCut

SLOTS = 5000


class RecordingArm(Arm):
    """The real arm, with a list of what it was asked to do."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.calls: list[str] = []
        self.written: list[Command] = []
        self.enable_error: Exception | None = None
        self.alter: Callable[[Sample], Sample] = lambda sample: sample

    def connect(self) -> None:
        self.calls.append("connect")
        self.arm.connect()

    def verify(self) -> None:
        self.calls.append("verify")
        self.arm.verify()

    def enable(self) -> None:
        self.calls.append("enable")
        if self.enable_error is not None:
            raise self.enable_error
        self.arm.enable()

    def read(self) -> Sample:
        return self.alter(self.arm.read())

    def write(self, command: Command) -> Sent:
        self.calls.append("write")
        self.written.append(command)
        return self.arm.write(command)

    def hold(self) -> Sent:
        self.calls.append("hold")
        return self.arm.hold()

    def disable(self) -> None:
        self.calls.append("disable")
        self.arm.disable()

    def inspect_with(self, inspector) -> None:
        self.arm.inspect_with(inspector)

    def clear_faults(self) -> None:
        self.calls.append("clear_faults")
        self.arm.clear_faults()

    def close(self) -> None:
        self.calls.append("close")
        self.arm.close()

    def truth(self) -> Truth | None:
        return self.arm.truth()


class Bench:
    """A loop on the twin, ticked by hand."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.clock = VirtualClock(1_000_000_000)
        self.link = Link.local(robot.dof, SLOTS)
        rig = open_backend("sim", robot, self.clock)
        self.plant = rig.arm._plant
        self.arm = RecordingArm(rig.arm)
        steps = [PoseStep(pose=robot.profile.home)]
        self.loop = Loop(robot, Rig(self.arm, rig.gripper), self.clock, self.link, steps)
        self.supervisor = self.loop.supervisor
        self.seq = 0
        self.cursor = 0

    def tick(self, count=1):
        for _ in range(count):
            self.clock.sleep_until(self.clock.now_ns() + self.robot.period_ns)
            self.loop.tick()
        return self.supervisor.state

    def ask(self, verb):
        """Ask, tick once, and return the text of the answer."""
        number = self.link.desk.ask(verb)
        self.tick()
        assert self.link.desk.answered(number)
        (answer,) = [event for event in self.events() if event["type"] == "answer" and event["number"] == number]
        assert answer["ok"] is not bool(answer["text"])
        return answer["text"]

    def events(self):
        events, self.cursor = self.link.events.since(self.cursor)
        return events

    def until(self, *states, seconds=10.0):
        for _ in range(round(seconds * self.robot.profile.servo_hz)):
            if self.supervisor.state in states:
                return self.supervisor.state
            self.tick()
        pytest.fail(f"{self.supervisor.state.name} instead of {states}: {self.supervisor.cause}")

    def reach(self, state):
        """Bring the loop from nothing into a state."""
        self.loop.bring_up()
        self.tick()
        if state is State.READY:
            return self
        assert self.ask(Verb.ARM) == ""
        self.tick(20)
        path = {
            State.ARMED: (),
            State.RUN: (Verb.START,),
            State.RESET: (Verb.PARK,),
            State.STOPPING: (Verb.START, Verb.STOP),
            State.HOLD: (Verb.START, Verb.STOP),
            State.DISABLED: (Verb.DISARM,),
            State.FAULT: (Verb.ESTOP,),
        }[state]
        if state is State.RESET:
            self.lead(0.2, 0.3)
            self.ask(Verb.STOP)
            self.until(State.HOLD)
            self.ask(Verb.ACK)
        for verb in path:
            if verb is Verb.STOP and state is State.STOPPING:
                self.put_velocity(0.2)
                self.tick(40)
            assert self.ask(verb) == ""
        self.until(state)
        return self

    def put(self, kind, *values, valid_s=0.1, epoch=None):
        self.seq += 1
        epoch = self.supervisor.epoch if epoch is None else epoch
        deadline = self.clock.now_ns() + round(valid_s * 1e9)
        self.link.mailbox.put(kind(*values, epoch, self.seq, deadline))

    def put_velocity(self, speed, joint=0, **about):
        velocity = np.zeros(self.robot.dof)
        velocity[joint] = speed
        self.put(JointVelocity, velocity, **about)

    def lead(self, speed, seconds, joint=0):
        """Start, and let a policy lead one joint."""
        if self.supervisor.state is State.ARMED:
            assert self.ask(Verb.START) == ""
        for _ in range(round(seconds * 20)):
            self.put_velocity(speed, joint)
            self.tick(25)

    @property
    def truth(self):
        return self.arm.arm._plant.truth()


@pytest.fixture
def bench(panda):
    return Bench(panda)


# -- verbs ---------------------------------------------------------------------------------------------------------

RESETS = {Verb.HOME, Verb.PARK, Verb.RETREAT, Verb.SETTLE, Verb.RANDOM_START, Verb.TASK_RESET}
ALLOWED = {
    State.READY: {Verb.ARM, Verb.CLOSE},
    State.ARMED: {Verb.START, Verb.STOP, Verb.DISARM, *RESETS},
    State.RUN: {Verb.STOP, Verb.DISARM},
    State.RESET: {Verb.STOP, Verb.DISARM},
    State.STOPPING: {Verb.STOP, Verb.DISARM},
    State.HOLD: {Verb.STOP, Verb.DISARM, Verb.ACK},
    State.FAULT: {Verb.ACK, Verb.CLOSE},
}


@pytest.mark.parametrize("verb", [verb for verb in Verb if verb is not Verb.ESTOP])
@pytest.mark.parametrize("state", ALLOWED)
def test_every_verb_in_every_state(bench, state, verb):
    bench.reach(state)
    bench.put_velocity(0.0)  # so that RUN misses no heartbeat
    text = bench.ask(verb)
    if verb in ALLOWED[state]:
        assert text == ""
    else:
        assert f"is refused in state {state.name}" in text
        assert bench.supervisor.state is state


@pytest.mark.parametrize("number", [0, 99, -1])
def test_an_unknown_verb_is_answered_not_obeyed(bench, number):
    bench.reach(State.ARMED)
    assert str(number) in bench.ask(number)
    assert bench.tick(5) is State.ARMED


def test_home_is_reached_and_ends_in_armed(bench):
    bench.reach(State.ARMED)
    bench.lead(0.3, 1.0)
    assert bench.ask(Verb.STOP) == ""
    bench.until(State.HOLD)
    assert bench.truth.position[0] == pytest.approx(bench.robot.profile.home[0] + 0.29, abs=0.05)
    assert bench.ask(Verb.ACK) == ""
    assert bench.supervisor.state is State.ARMED
    assert bench.ask(Verb.HOME) == ""
    assert bench.supervisor.state is State.RESET
    bench.until(State.ARMED)
    bench.tick(100)
    assert bench.truth.position == pytest.approx(np.array(bench.robot.profile.home), abs=5e-3)


def test_disarming_ends_in_ready_with_the_drives_off(bench):
    bench.reach(State.ARMED)
    bench.lead(0.3, 0.5)
    assert bench.ask(Verb.DISARM) == ""
    assert bench.supervisor.state is State.STOPPING
    bench.until(State.READY)
    assert bench.arm.calls[-1] == "disable"
    assert not bench.arm.read().enabled
    assert bench.supervisor.cause is None
    assert bench.supervisor.trips == []
    assert bench.ask(Verb.ARM) == ""
    assert bench.tick() is State.ARMED


def test_a_drive_that_does_not_enable_ends_in_a_fault_with_its_words(bench):
    bench.reach(State.READY)
    bench.arm.enable_error = DriveError("panda_joint3", 3, "did not enable", "check its supply")
    assert "did not enable" in bench.ask(Verb.ARM)
    bench.until(State.FAULT)
    assert "did not enable" in bench.supervisor.cause.cause


# -- silence -------------------------------------------------------------------------------------------------------


def test_bring_up_verifies_and_enables_nothing(bench):
    bench.loop.bring_up()
    bench.tick(50)
    assert bench.arm.calls == ["connect", "verify"]
    assert bench.supervisor.state is State.READY


@pytest.mark.parametrize("state", [State.READY, State.FAULT])
def test_nothing_is_written_with_the_drives_off(bench, state):
    bench.reach(state)
    bench.arm.calls.clear()
    for _ in range(20):
        bench.put_velocity(0.5)
        bench.tick(5)
    assert bench.arm.calls == []
    assert bench.supervisor.state is state


def test_a_failed_self_test_leaves_silence(bench, monkeypatch):
    bench.reach(State.FAULT)
    bench.arm.calls.clear()

    def refuse():
        bench.arm.calls.append("verify")
        raise DriveError("panda_joint1", 1, "is somebody else")

    monkeypatch.setattr(bench.arm, "verify", refuse)
    assert "is somebody else" in bench.ask(Verb.ACK)
    assert bench.supervisor.state is State.SILENT
    bench.tick(50)
    assert bench.arm.calls == ["disable", "verify"]


@pytest.mark.parametrize("state", [s for s in ENABLED if s is not State.STOPPING])
def test_every_tick_of_an_enabled_state_feeds_the_drives(bench, state):
    bench.reach(state)
    for _ in range(20):
        before = len(bench.arm.written)
        bench.put_velocity(0.0)
        bench.tick()
        assert len(bench.arm.written) == before + 1


# -- emergency stop ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("through", ["signal", "desk"])
@pytest.mark.parametrize("state", sorted(ENABLED))
def test_an_emergency_stop_takes_one_tick_from_every_enabled_state(bench, state, through):
    bench.reach(state)
    epoch = bench.supervisor.epoch
    if through == "signal":
        bench.loop.estop("a test")
    else:
        bench.link.desk.ask(Verb.ESTOP)
    assert bench.tick() is State.STOPPING
    assert int(bench.supervisor.category) == 1
    assert bench.supervisor.epoch == epoch + 1
    (trip,) = [event for event in bench.events() if event["type"] == "trip"]
    assert (trip["protection"], trip["stop_category"]) == ("P23", 1)
    assert trip["reaction_ms"] <= 2.0
    assert "acknowledge" in trip["text"]
    bench.until(State.FAULT)
    assert not bench.arm.read().enabled


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.START, Verb.HOME])
def test_an_emergency_stop_beats_whatever_else_is_asked_in_the_same_tick(bench, verb):
    state = State.READY if verb is Verb.ARM else State.ARMED
    bench.reach(state)
    bench.loop.estop("a test")
    assert "refused" in bench.ask(verb)
    assert bench.supervisor.state is (State.FAULT if state is State.READY else State.STOPPING)
    assert "enable" not in bench.arm.calls[-1:]


def test_an_emergency_stop_brakes_a_motion_within_the_published_time(bench):
    bench.reach(State.ARMED)
    bench.lead(1.0, 1.0)
    assert bench.truth.velocity[0] > 0.7
    bench.loop.estop("a test")
    bench.tick(round(bench.robot.stopping_time_s * bench.robot.profile.servo_hz))
    assert np.abs(bench.truth.velocity).max() < 0.05


def test_after_a_fault_acknowledging_runs_the_self_test_and_moves_nothing(bench):
    bench.reach(State.FAULT)
    bench.arm.calls.clear()
    assert "refused" in bench.ask(Verb.ARM)
    assert bench.ask(Verb.ACK) == ""
    assert "verify" in bench.arm.calls
    assert "enable" not in bench.arm.calls
    assert "clear_faults" not in bench.arm.calls
    assert bench.supervisor.state is State.READY
    assert bench.ask(Verb.ARM) == ""
    assert bench.ask(Verb.START) == ""


# -- epochs and targets --------------------------------------------------------------------------------------------


def test_a_target_of_an_old_epoch_never_runs_after_a_stop(bench):
    bench.reach(State.ARMED)
    bench.lead(0.3, 0.5)
    old = bench.supervisor.epoch
    bench.ask(Verb.STOP)
    bench.until(State.HOLD)
    bench.ask(Verb.ACK)
    bench.tick(100)
    before = bench.truth.position
    assert bench.ask(Verb.START) == ""
    for _ in range(40):
        bench.put_velocity(0.5, epoch=old)
        bench.tick()
    assert np.abs(bench.truth.position - before).max() < 2e-3
    assert bench.supervisor.state is State.RUN
    bench.put_velocity(0.5)
    bench.tick(40)
    assert bench.truth.position[0] > before[0] + 0.01


def test_hold_keeps_a_running_arm_where_it_is(bench):
    bench.reach(State.ARMED)
    bench.tick(100)
    before = bench.truth.position
    assert bench.ask(Verb.START) == ""
    for _ in range(20):
        bench.put(Hold)
        bench.tick(25)
    assert bench.supervisor.state is State.RUN
    assert np.abs(bench.truth.position - before).max() < 2e-3


def test_a_silent_policy_stops_the_arm_and_resumes_in_time(bench):
    bench.reach(State.ARMED)
    bench.lead(0.3, 0.5)
    bench.tick(60)
    assert bench.supervisor.state in (State.STOPPING, State.HOLD)
    bench.put_velocity(0.3)
    assert bench.tick(2) is State.RUN
    trips = [event for event in bench.events() if event["type"] == "trip"]
    assert [(trip["protection"], trip["reaction_ms"]) for trip in trips] == [("P10", pytest.approx(0.0, abs=2.0))]


# -- torque --------------------------------------------------------------------------------------------------------


def test_a_torque_target_rides_on_gravity_and_is_rate_limited():
    bench = Bench(load_robot("panda", [f"joints.{joint}.acceleration=200" for joint in range(7)]))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    bench.arm.written.clear()
    torque = np.zeros(7)
    torque[0] = 3.0
    gravity = bench.loop.kinematics.gravity
    step = bench.robot.limits.torque_rate * 2e-3
    previous = bench.loop._motion.command.effort
    for _ in range(8):
        bench.put(JointTorque, torque)
        bench.tick()
        command = bench.arm.written[-1]
        assert command.mode is CommandMode.EFFORT
        assert (np.abs(command.effort - previous) <= step * (1 + 1e-9)).all()
        previous = command.effort
    assert command.effort == pytest.approx(gravity(bench.arm.read().position) + torque, abs=0.1)
    first = bench.arm.written[0].effort - gravity(bench.truth.position)
    assert first[0] < 2.5  # it took several ticks
    assert bench.supervisor.state is State.RUN


def test_a_torque_that_pushes_for_ever_is_shaped_and_breaks_nothing(bench):
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    torque = np.zeros(7)
    torque[0] = 20.0
    for _ in range(2000):
        bench.put(JointTorque, torque)
        bench.tick()
    assert bench.supervisor.state is State.RUN
    records, _, _ = bench.link.ticks.since(0)
    limits, tolerance = bench.robot.limits, bench.robot.profile.safety.velocity_tolerance
    assert (np.abs(records["true_velocity"]) <= limits.velocity + tolerance).all()
    assert (records["true_position"] <= limits.upper).all()
    assert (records["true_position"] >= limits.lower).all()
    outside = np.linalg.norm(records["true_tool"] - bench.robot.profile.sphere.centre, axis=1)
    assert outside.max() <= bench.robot.profile.sphere.radius + 2e-3


def test_a_push_that_torques_cannot_stop_in_time_hands_over_to_braking(bench):
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    shove = np.zeros(7)
    shove[6] = 12.5
    bench.plant.push(shove)
    for _ in range(200):
        bench.put(FreeDrive)
        if bench.tick() is not State.RUN:
            break
    bench.plant.push(np.zeros(7))
    assert bench.supervisor.cause.protection.label == "P8"
    assert bench.arm.written[-1].mode is CommandMode.TRACK
    bench.until(State.HOLD)


def test_velocity_after_torque_goes_on_from_the_measured_motion(bench):
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    torque = np.zeros(7)
    torque[0] = 3.0
    for _ in range(60):
        bench.put(JointTorque, torque)
        bench.tick()
    speed = bench.truth.velocity[0]
    assert speed > 0.05
    for _ in range(5):
        bench.put_velocity(speed)
        bench.tick()
        assert bench.arm.written[-1].mode is CommandMode.TRACK
    assert np.abs(bench.arm.written[-1].position - bench.truth.position).max() < 0.01
    assert bench.truth.velocity[0] == pytest.approx(speed, abs=0.1)


@pytest.mark.parametrize("jump", [0.1, 0.3, 1.0, 4.0, float("nan")])
def test_one_broken_sample_in_torque_mode_is_not_where_the_arm_is_pulled_to(bench, jump):
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    for _ in range(50):
        bench.put(FreeDrive)
        bench.tick()
    before, broken = bench.truth.position, [True]

    def break_one(sample):
        offset = np.zeros(7)
        offset[0] = jump if broken.pop() else 0.0
        broken.append(False)
        return sample._replace(position=sample.position + offset)

    bench.arm.alter = break_one
    for _ in range(500):
        bench.put(FreeDrive)
        bench.tick()
        assert np.abs(bench.truth.position - before).max() < 0.01
        assert np.abs(bench.truth.velocity).max() < 0.2
    assert bench.supervisor.state is State.RUN


def test_free_drive_lets_itself_be_led_and_stays_where_it_is_left(bench):
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""

    def lead_by_hand(speed, ticks):
        """A person who moves the first joint at a speed, or lets go of it."""
        for _ in range(ticks):
            hand = np.zeros(7)
            hand[0] = 0.0 if speed is None else 5.0 * (speed - bench.truth.velocity[0])
            bench.plant.push(hand)
            bench.put(FreeDrive)
            bench.tick()
            assert bench.arm.written[-1].mode is CommandMode.EFFORT
        return bench.truth.position

    before = lead_by_hand(None, 100)
    assert lead_by_hand(0.2, 250)[0] - before[0] == pytest.approx(0.1, abs=0.03)
    left = lead_by_hand(0.0, 250)
    assert np.abs(lead_by_hand(None, 100) - left).max() < 0.01
    assert bench.supervisor.state is State.RUN
    assert bench.ask(Verb.STOP) == ""
    bench.until(State.HOLD)
    rest = bench.truth.position
    bench.tick(100)
    assert np.abs(bench.truth.position - rest).max() < 0.01


# -- recovery ------------------------------------------------------------------------------------------------------


def test_armed_outside_its_limits_it_may_do_nothing_but_retreat(bench):
    bench.loop.bring_up()
    outside = np.array(bench.robot.profile.home)
    outside[4] = bench.robot.limits.upper[4] + 0.05
    bench.plant.place(outside)
    bench.tick()
    assert bench.ask(Verb.ARM) == ""
    bench.tick(20)
    assert bench.supervisor.state is State.ARMED
    assert int(bench.link.ticks.latest()["clip"]) & Clip.RECOVERY
    for verb in (Verb.START, *(RESETS - {Verb.RETREAT})):
        assert "refused" in bench.ask(verb)
    assert bench.truth.position[4] > bench.robot.limits.upper[4]
    assert bench.ask(Verb.RETREAT) == ""
    bench.until(State.ARMED, seconds=30)
    bench.tick(50)
    assert bench.truth.position[4] < bench.robot.limits.upper[4]
    assert not int(bench.link.ticks.latest()["clip"]) & Clip.RECOVERY
    assert bench.ask(Verb.START) == ""


def test_a_breach_of_the_limits_ends_in_a_fault_and_leads_to_a_retreat():
    bench = Bench(load_robot("panda", ["safety.tracking_error=10"]))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    shift, way = np.zeros(7), bench.robot.limits.upper[6] - bench.robot.profile.home[6] + 0.3

    def slip(sample):
        shift[6] = min(shift[6] + 5e-3, way)
        return sample._replace(position=sample.position + shift)

    bench.arm.alter = slip
    for _ in range(600):
        bench.put_velocity(0.0)
        if bench.tick() is not State.RUN:
            break
    assert bench.supervisor.state is State.STOPPING
    assert bench.supervisor.trips[0].protection.label == "P3"
    bench.until(State.FAULT)
    assert bench.ask(Verb.ACK) == ""
    assert bench.ask(Verb.ARM) == ""
    assert "refused" in bench.ask(Verb.START)


# -- closing -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.READY, State.FAULT])
def test_closing_takes_the_torque_away_and_releases_the_arm(bench, state):
    bench.reach(state)
    assert bench.ask(Verb.CLOSE) == ""
    assert bench.loop.closed
    assert bench.supervisor.state is State.OFF
    assert bench.arm.calls[-2:] == ["disable", "close"]
    calls = len(bench.arm.calls)
    bench.loop.shut_down()
    assert len(bench.arm.calls) == calls


def test_shutting_down_in_motion_takes_the_torque_away(bench):
    bench.reach(State.ARMED)
    bench.lead(0.3, 0.3)
    bench.loop.shut_down()
    assert bench.arm.calls[-2:] == ["disable", "close"]


def test_an_arm_without_brakes_is_damped_after_a_stop_and_lowered_when_closed():
    bench = Bench(load_robot("openarm"))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.HOME) == ""
    bench.until(State.ARMED, seconds=30)
    bench.loop.estop("a test")
    bench.until(State.FAULT)
    where = bench.truth.position
    bench.tick(1000)
    assert {command.mode for command in bench.arm.written[-1000:]} == {CommandMode.DAMP}
    assert np.abs(bench.truth.position - where).max() < 0.1
    gravity = bench.loop.kinematics.gravity(bench.truth.position)
    assert bench.arm.written[-1].effort == pytest.approx(gravity, abs=0.05)
    assert bench.ask(Verb.CLOSE) == ""
    assert not bench.loop.closed
    fastest = 0.0
    for _ in range(1100):
        if bench.loop.closed:
            break
        bench.tick()
        fastest = max(fastest, float(np.abs(bench.truth.velocity).max()))
    assert bench.loop.closed
    assert bench.supervisor.state is State.OFF
    assert bench.arm.calls[-2:] == ["disable", "close"]
    assert np.abs(bench.truth.position - where).max() > 0.2  # it went down
    assert fastest < 2.5


def test_an_arm_without_brakes_is_lowered_before_its_drives_go_off():
    bench = Bench(load_robot("openarm"))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.DISARM) == ""
    bench.until(State.DISABLED)
    began = len(bench.arm.written)
    bench.until(State.READY)
    lowering = bench.arm.written[began:]
    assert len(lowering) == pytest.approx(2.0 * 500, abs=5)
    assert {command.mode for command in lowering} == {CommandMode.DAMP}
    assert bench.arm.calls[-1] == "disable"


def test_closing_while_an_arm_is_being_lowered_waits_until_it_is_down():
    bench = Bench(load_robot("openarm"))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.DISARM) == ""
    bench.until(State.DISABLED)
    bench.tick(100)
    assert bench.ask(Verb.CLOSE) == ""
    for _ in range(1100):
        if bench.loop.closed:
            break
        bench.tick()
    assert bench.loop.closed
    assert bench.supervisor.state is State.OFF
    assert bench.arm.calls[-2:] == ["disable", "close"]


def test_an_emergency_stop_latches_while_an_arm_is_being_lowered():
    bench = Bench(load_robot("openarm"))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.DISARM) == ""
    bench.until(State.DISABLED)
    bench.tick(100)
    bench.loop.estop("a test")
    assert bench.tick() is State.FAULT
    lowered = bench.tick(1000)
    assert lowered is State.FAULT
    assert bench.arm.calls[-1] == "disable"
    assert [trip.protection.label for trip in bench.supervisor.trips] == ["P23"]


def test_an_arm_is_not_damped_by_where_it_was_once():
    """The gravity of a pose that is no longer measured would push the arm about for as long as nobody comes."""
    session = LockstepSession(load_robot("openarm"), "can")
    session.open()
    session.request(Verb.ARM)
    session.loop.estop("a test")
    with pytest.raises(Stopped):
        session.wait_for(State.HOLD, timeout_s=3.0)
    bench = session._rig.arm._channel.bus.bench
    session.advance(0.5)
    assert all(drive.enabled for drive in bench.drives)
    bench.trouble.add(Mute(motor_id=2))
    session.advance(0.5)
    assert not any(drive.enabled for drive in bench.drives)


@pytest.mark.parametrize(("speed", "seconds", "on"), [(1.3, 0.05, True), (1.1, 0.5, True), (1.3, 0.2, False)])
def test_a_drive_that_runs_away_while_the_arm_is_damped_is_switched_off(speed, seconds, on):
    bench = Bench(load_robot("openarm")).reach(State.ARMED)
    bench.loop.estop("a test")
    bench.until(State.FAULT)
    fast = np.zeros(7)
    fast[3] = speed * bench.robot.limits.velocity[3]
    bench.arm.alter = lambda sample: sample._replace(velocity=fast)
    bench.tick(round(seconds * bench.robot.profile.servo_hz))
    assert bench.arm.arm.enabled is on


def test_a_joint_that_is_not_heard_of_is_not_pushed_about(bench):
    """What the integrator sees of it is an error that does not change, whatever it does."""
    bench.reach(State.ARMED)
    bench.lead(0.9, 0.5)
    seen = bench.arm.arm.read()
    frozen = {key: getattr(seen, key) for key in ("position", "velocity", "joint_stamp_ns")}
    bench.arm.alter = lambda sample: sample._replace(**frozen)
    bench.tick(round(0.3 * bench.robot.profile.servo_hz))
    where = bench.truth.position
    bench.tick(round(0.3 * bench.robot.profile.servo_hz))
    assert bench.truth.position == pytest.approx(where, abs=2e-3)
    assert bench.supervisor.cause.protection.label == "P12"


def test_a_reset_routine_brakes_while_a_joint_is_not_heard_of():
    session = LockstepSession(load_robot("panda"), "can")
    session.open()
    session.request(Verb.ARM)
    session.request(Verb.START)
    for seq in range(10):
        epoch, deadline = int(session.latest()["epoch"]), session.clock.now_ns() + 10**8
        session.link.mailbox.put(JointVelocity(np.full(7, 0.3), epoch, seq, deadline))
        session.advance(0.05)
    session.end()
    session.request(Verb.HOME)
    session.advance(0.1)
    fastest = np.abs(session.latest()["command_velocity"]).max()
    mute = Mute(motor_id=1)
    session._rig.arm._channel.bus.bench.trouble.add(mute)
    session.advance(0.045)
    assert session.state is State.RESET
    assert np.abs(session.latest()["command_velocity"]).max() < 0.6 * fastest
    session._rig.arm._channel.bus.bench.trouble.remove(mute)
    session.wait_for(State.ARMED, timeout_s=30.0)
    assert session.trips == []


# -- what is published ---------------------------------------------------------------------------------------------


def test_every_tick_leaves_a_record_of_what_was_measured_and_sent(bench):
    bench.reach(State.ARMED)
    first = bench.link.ticks.head
    bench.lead(0.3, 0.5)
    records, _, _ = bench.link.ticks.since(first)
    assert (np.diff(records["tick"]) == 1).all()
    assert (np.diff(records["stamp_ns"]) == bench.robot.period_ns).all()
    written = bench.arm.written[-len(records) :]
    assert (records["command_position"] == [command.position for command in written]).all()
    assert (records["command_effort"] == [command.effort for command in written]).all()
    assert records["wanted"][-1][0] == 0.3
    assert (records["position"] == records["true_position"]).all()
    assert records["has_truth"].all()
    assert int(records[-1]["epoch"]) == bench.supervisor.epoch


def test_state_changes_and_trips_are_told_as_they_happen(bench):
    bench.reach(State.ARMED)
    bench.events()
    bench.loop.estop("a test")
    bench.until(State.FAULT)
    bench.tick()
    told = [event["text"] for event in bench.events() if event["type"] == "state"]
    assert told == ["ARMED -> STOPPING", "STOPPING -> FAULT"]


def test_a_drive_that_loses_its_power_ends_in_a_fault_on_can():
    session = LockstepSession(load_robot("panda"), "can")
    session.open()
    session.request(Verb.ARM)
    session.advance(0.1)
    session._rig.arm._channel.bus.bench.trouble.add(PowerCut(motor_id=3))
    with pytest.raises(Stopped, match="panda_joint3"):
        session.wait_for(State.HOLD, timeout_s=3.0)
    session.advance(0.1)
    assert session.state is State.FAULT
    assert session.trips[0]["stop_category"] == 1
    assert not any(drive.enabled for drive in session._rig.arm._channel.bus.bench.drives)
    with pytest.raises(DriveError, match="did not confirm"):
        session.close()


@pytest.mark.parametrize("told", [True, False])
def test_a_late_tick_does_not_leave_the_reference_behind(told: bool) -> None:
    """The drives go on at the speed they were given; a reference that stands still meanwhile would pull them back."""
    robot = load_robot("panda")
    with LockstepSession(robot, "sim") as session:
        session.prepare()
        session.begin()
        worst = 0.0
        for step in range(60):
            record = session.latest()
            wanted = np.array([0.8 if step < 40 else 0.0, *np.zeros(6)])
            deadline = session.clock.now_ns() + 100_000_000
            session.link.mailbox.put(JointVelocity(wanted, int(record["epoch"]), step, deadline))
            session.advance(0.02)
            if step % 10 == 5:  # three ticks do not take place
                session.clock.sleep_until(session.clock.now_ns() + 4 * robot.period_ns)
                session._next_ns = session.clock.now_ns()
                session.loop.skipped = 3 if told else 0
                session.loop.tick()
                session.loop.skipped = 0
                session._next_ns += robot.period_ns
            record = session.latest()
            worst = max(worst, np.abs(record["command_position"] - record["true_position"]).max())
        assert bool(worst < 1.5e-3) is told, worst


def test_a_gap_between_ticks_brakes_and_switches_off(bench):
    bench.reach(State.ARMED)
    bench.lead(0.5, 0.5)
    bench.clock.sleep_until(bench.clock.now_ns() + 25_000_000)
    bench.loop.skipped = 12
    assert bench.tick() is State.STOPPING
    bench.loop.skipped = 0
    bench.until(State.FAULT)
    (trip,) = [event for event in bench.events() if event["type"] == "trip"]
    assert (trip["protection"], trip["stop_category"]) == ("P11", 1)
    assert trip["reaction_ms"] == pytest.approx(5.0)  # 27 ms after the last tick, where 22 are allowed


def test_late_ticks_in_a_row_brake_and_hold(bench):
    bench.reach(State.ARMED)
    bench.loop.lateness_ns = bench.robot.period_ns + 1
    assert bench.tick(4) is State.ARMED
    assert bench.tick() is State.STOPPING
    bench.until(State.HOLD)
    assert [trip.protection.label for trip in bench.supervisor.trips] == ["P11"]


def test_drives_that_take_their_time_to_come_on_are_no_overrun(bench):
    bench.reach(State.READY)
    enable = bench.arm.arm.enable

    def slow():
        bench.clock.sleep_until(bench.clock.now_ns() + 500_000_000)
        enable()

    bench.arm.arm.enable = slow
    assert bench.ask(Verb.ARM) == ""
    assert bench.tick(10) is State.ARMED


def test_with_the_drives_off_a_late_loop_is_none_of_safetys_business(bench):
    bench.reach(State.READY)
    bench.clock.sleep_until(bench.clock.now_ns() + 10**9)
    assert bench.tick() is State.READY


# -- neighbours ----------------------------------------------------------------------------------------------------


def powers_during(bench, call):
    """Let a call of the arm note what the watchman is told meanwhile."""
    seen, original = [], getattr(bench.arm, call)

    def noting():
        seen.append(bench.link.watch.power)
        original()

    setattr(bench.arm, call, noting)
    return seen


def test_the_watchman_is_told_when_the_drives_are_on_and_when_that_changes(bench):
    bench.reach(State.READY)
    coming, going = powers_during(bench, "enable"), powers_during(bench, "disable")
    assert bench.link.watch.power is Power.OFF
    assert bench.ask(Verb.ARM) == ""
    assert coming == [Power.CHANGING]
    bench.lead(0.3, 0.2)
    assert bench.link.watch.power is Power.ON
    assert bench.ask(Verb.DISARM) == ""
    assert bench.link.watch.power is Power.ON
    bench.until(State.READY)
    assert going == [Power.CHANGING]
    assert bench.link.watch.power is Power.OFF
    bench.loop.shut_down()
    assert going == [Power.CHANGING, Power.OFF]  # what is off cannot be left half on


def test_drives_that_do_not_confirm_are_left_to_the_watchman(bench):
    bench.reach(State.ARMED)

    def fail():
        raise DriveError("panda_joint1", 1, "did not confirm")

    bench.arm.disable = fail
    with pytest.raises(DriveError):
        bench.loop.shut_down()
    assert bench.link.watch.power is Power.CHANGING


def test_an_arm_that_is_damped_is_watched_until_it_is_down():
    bench = Bench(load_robot("openarm"))
    bench.reach(State.FAULT)
    bench.tick(100)
    assert bench.link.watch.power is Power.ON
    assert bench.ask(Verb.CLOSE) == ""
    while not bench.loop.closed:
        assert bench.link.watch.power is Power.ON
        bench.tick()
    assert bench.link.watch.power is Power.OFF


@pytest.mark.parametrize("state", [State.ARMED, State.RUN])
@pytest.mark.parametrize("shows_life", [True, False])
def test_an_arm_that_nobody_watches_does_not_move_on(bench, state, shows_life):
    bench.reach(State.ARMED)
    for _ in range(10):
        if shows_life:
            bench.link.watch.beat()
        bench.tick()
    if state is State.RUN:
        bench.lead(0.2, 0.95)
        assert bench.supervisor.state is State.RUN
        bench.lead(0.2, 0.1)
    else:
        bench.tick(1000)
    labels = [trip.protection.label for trip in bench.supervisor.trips]
    assert labels == (["P27"] if shows_life and state is State.RUN else [])
    assert all(trip.category is Category.BRAKE_HOLD for trip in bench.supervisor.trips)


def test_a_drive_that_gets_hot_is_warned_of_once(bench):
    bench.reach(State.ARMED)
    warm = np.full(7, 30.0)
    warm[3] = 85.0
    bench.arm.alter = lambda sample: sample._replace(temperature=warm)
    bench.events()
    bench.tick(5)
    warnings = [event["text"] for event in bench.events() if event["type"] == "log"]
    assert warnings == ["warning: panda_joint4 is at 85 degrees C"]
    assert bench.supervisor.state is State.ARMED


def test_an_arm_that_is_pushed_stops_and_gives_way():
    bench = Bench(load_robot("panda"))
    bench.reach(State.ARMED)
    assert bench.ask(Verb.START) == ""
    for _ in range(20):
        bench.put_velocity(0.0)
        bench.tick()
    hand = np.zeros(7)
    for tick in range(300):
        hand[0] = max(-0.1 * tick, -14.5)
        bench.plant.push(hand)
        bench.put_velocity(0.0)
        bench.tick()
    assert [trip.protection.label for trip in bench.supervisor.trips] == ["P19"]
    before = bench.truth.position[0]
    bench.tick(500)
    assert bench.truth.position[0] < before - 0.1  # it goes where it is pushed, and slowly
    assert abs(bench.truth.velocity[0]) < 0.4
    for tick in range(500):
        hand[0] = min(-14.5 + 0.1 * tick, 0.0)
        bench.plant.push(hand)
        bench.tick()
    bench.tick(1000)
    assert bench.supervisor.state is State.HOLD
    assert np.abs(bench.truth.velocity).max() < 0.05
    assert bench.ask(Verb.ACK) == ""
