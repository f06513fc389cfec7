"""The guard: what may leave in which state, what leaves together, and the time that a motion has."""

import itertools

import numpy as np
import pytest

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    MitCommand,
    Offset,
    PosForceCommand,
    RegisterCommand,
    Special,
    encode_mit,
    encode_pos_force,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode, Sample
from robotctl.safety.asked import Kind
from robotctl.safety.guard import PERMITTED, Guard
from robotctl.safety.machine import ENABLED, State
from robotctl.safety.trip import Protection

PANDA = load_robot("panda")
HOME = np.array(PANDA.profile.home)
SAFETY = PANDA.profile.safety
REST = np.zeros(7)
PERIOD = PANDA.period_ns
MS = 1_000_000
ANGLE_QUANTUM = 4e-4


class Bench:
    """A guard in a state that a test sets, and its clock."""

    def __init__(self, state=State.RUN, robot=PANDA):
        self.state = state
        self.guard = Guard(robot, lambda: self.state)
        self.now = 0
        self.tick(0)

    def tick(self, after=PERIOD, position=HOME, late=0):
        self.now += after
        self.guard.observe(Sample(self.now, position, REST, REST, np.full(7, self.now)), self.now, late)
        return self

    def command(self, mode=CommandMode.TRACK, position=HOME, velocity=REST, effort=REST):
        """Offer a command and return the protection that it was refused for."""
        text = self.guard.command(Command(mode, position, velocity, effort))
        refusal = self.guard.take()
        assert text == ("" if refusal is None else refusal.text)
        return None if refusal is None else refusal.protection

    def frames(self, *frames):
        text = self.guard.frames(frames)
        refusal = self.guard.take()
        assert text == ("" if refusal is None else refusal.text)
        return None if refusal is None else refusal.protection


def joint_frame(index, position=None, velocity=0.0, kp=None, kd=None, effort=0.0):
    joint = PANDA.profile.joints[index]
    drive = joint.drive
    position = HOME[index] if position is None else position
    kp = joint.gains.kp if kp is None else kp
    kd = joint.gains.kd if kd is None else kd
    command = MitCommand(drive.sign * (position - drive.offset), drive.sign * velocity, kp, kd, drive.sign * effort)
    return drive.id, encode_mit(command, MOTORS[drive.motor])


def all_frames(**fields):
    return [joint_frame(index, **fields) for index in range(7)]


FRAMES = {
    Kind.READ: (BROADCAST_ID, encode_register(1, RegisterCommand.READ, 7)),
    Kind.MODE: (BROADCAST_ID, encode_register(1, RegisterCommand.WRITE, Register.CTRL_MODE)),
    Kind.STORE: (BROADCAST_ID, encode_register(1, RegisterCommand.SAVE)),
    Kind.ENABLE: (1, encode_special(Special.ENABLE)),
    Kind.DISABLE: (1, encode_special(Special.DISABLE)),
    Kind.CLEAR: (1, encode_special(Special.CLEAR_ERROR)),
    Kind.ZERO: (1, encode_special(Special.SET_ZERO)),
    Kind.TRACK: joint_frame(0),
    Kind.TORQUE: joint_frame(0, kp=0.0, kd=0.0),
    Kind.DAMP: joint_frame(0, kp=0.0),
    Kind.GRIP: (8 + Offset.POS_FORCE, encode_pos_force(PosForceCommand(1.0, 1.0, 0.05))),
}
EXPECTED = {
    Kind.READ: set(State) - {State.OFF},
    Kind.DISABLE: set(State) - {State.OFF},
    Kind.MODE: {State.SILENT},
    Kind.START: {State.SILENT, State.ARMED},
    Kind.ENABLE: {State.ARMED},
    Kind.TRACK: {State.ARMED, State.RUN, State.RESET, State.STOPPING, State.HOLD},
    Kind.TORQUE: {State.RUN},
    Kind.DAMP: {State.ARMED, State.RUN, State.RESET, State.STOPPING, State.HOLD, State.DISABLED, State.FAULT},
    Kind.GRIP: {State.ARMED, State.RUN, State.RESET, State.STOPPING, State.HOLD, State.DISABLED, State.FAULT},
    Kind.CLEAR: set(),
    Kind.ZERO: set(),
    Kind.STORE: set(),
}


def test_the_list_knows_every_kind():
    assert {kind: set(PERMITTED[kind]) for kind in Kind} == EXPECTED


@pytest.mark.parametrize("state", State)
def test_a_canopen_drive_may_be_started_before_it_is_enabled(state):
    refused = Bench(state, load_robot("xarm7")).frames((0x000, b"\x01\x01"))
    assert refused is (None if state in EXPECTED[Kind.START] else Protection.FRAMES)


@pytest.mark.parametrize(("kind", "state"), list(itertools.product(FRAMES, State)))
def test_every_kind_of_frame_in_every_state(kind, state):
    refused = Bench(state).frames(FRAMES[kind])
    assert refused is (None if state in EXPECTED[kind] else Protection.FRAMES)


@pytest.mark.parametrize(("mode", "kind"), [
    (CommandMode.TRACK, Kind.TRACK), (CommandMode.EFFORT, Kind.TORQUE), (CommandMode.DAMP, Kind.DAMP),
])  # fmt: skip
@pytest.mark.parametrize("state", State)
def test_commands_without_a_wire_keep_the_same_list(mode, kind, state):
    assert Bench(state).command(mode) is (None if state in EXPECTED[kind] else Protection.FRAMES)


@pytest.mark.parametrize("state", State)
def test_enabling_without_a_wire(state):
    bench = Bench(state)
    text = bench.guard.enabling()
    assert text == ("" if state is State.ARMED else f"ENABLE is not permitted in state {state.name}")
    assert (bench.guard.take() is None) is (state is State.ARMED)


def test_every_other_id_is_refused_in_every_state():
    known = {*range(1, 9), 8 + Offset.POS_FORCE, BROADCAST_ID}
    data = joint_frame(0)[1]
    for state in State:
        bench = Bench(state)
        for arbitration_id in [*set(range(0x800)) - known, 0x800, 0x12345, 0x1FFFFFFF]:
            assert bench.frames((arbitration_id, data)) is Protection.FRAMES
    assert "frame 123#" in Bench().guard.frames([(0x123, data)])


def test_one_bad_frame_keeps_them_all_back():
    bench = Bench()
    assert bench.frames(*all_frames(), (0x55, bytes(8))) is Protection.FRAMES
    assert bench.frames(*all_frames(), FRAMES[Kind.CLEAR]) is Protection.FRAMES
    assert bench.frames(*all_frames(), FRAMES[Kind.READ], FRAMES[Kind.GRIP]) is None


@pytest.mark.parametrize("index", range(7))
def test_what_one_joint_is_refused_nothing_leaves_and_nothing_is_remembered(index):
    bench = Bench()
    assert bench.frames(*all_frames()) is None
    frames = all_frames()
    frames[index] = joint_frame(index, velocity=0.9)
    frames[(index + 1) % 7] = joint_frame((index + 1) % 7, velocity=0.005)
    assert bench.tick().frames(*frames) is Protection.ACCELERATION
    assert bench.tick().frames(*all_frames()) is None


def test_commands_are_judged_joint_by_joint():
    for index in range(7):
        bench = Bench()
        assert bench.command() is None
        fast = REST.copy()
        fast[index] = 0.9
        assert bench.tick().command(velocity=fast) is Protection.ACCELERATION


def test_fields_that_a_mode_does_not_use_are_not_judged():
    """Without a wire a command still carries them; the drives never see them."""
    bench = Bench()
    assert bench.command(CommandMode.DAMP, velocity=np.ones(7)) is None
    assert bench.command(CommandMode.EFFORT, velocity=np.ones(7)) is None


def test_the_first_refusal_is_the_one_that_is_told():
    bench = Bench()
    bench.guard.command(Command(CommandMode.TRACK, HOME + 1.0, REST, REST))
    bench.guard.frames([(0x55, bytes(8))])
    assert bench.guard.take().protection is Protection.BUMP
    assert bench.guard.take() is None


def test_in_armed_and_hold_nothing_is_led_anywhere():
    for state in ENABLED:
        bench = Bench(state)
        moving = bench.command(velocity=np.full(7, 0.055))
        assert moving is (Protection.FRAMES if state in (State.ARMED, State.HOLD) else None)


@pytest.mark.parametrize("state", sorted(set(State) - ENABLED))
def test_with_the_drives_off_what_was_asked_before_is_forgotten(state):
    bench = Bench()
    assert bench.command() is None
    bench.state = state
    bench.tick()
    bench.state = State.ARMED
    elsewhere = HOME + 0.1
    assert bench.tick(position=elsewhere).command(position=elsewhere) is None


def test_with_the_drives_on_it_is_not():
    bench = Bench()
    assert bench.command() is None
    elsewhere = HOME + 0.1
    assert bench.tick(position=elsewhere).command(position=elsewhere) is Protection.VELOCITY


def test_before_anything_was_measured_nothing_moves():
    guard = Guard(PANDA, lambda: State.RUN)
    assert guard.command(Command(CommandMode.TRACK, HOME, REST, REST)) != ""
    assert guard.frames([joint_frame(0)]) != ""


# -- time ----------------------------------------------------------------------------------------------------------


def steps(bench, count):
    """Ask for so many periods' worth of full acceleration at once."""
    velocity = np.minimum(count * 2e-3 * PANDA.limits.acceleration, PANDA.limits.velocity)
    return bench.command(velocity=velocity)


def standing(late=0):
    bench = Bench()
    bench.guard = Guard(PANDA, lambda: bench.state)
    bench.tick(0, late=late)
    assert bench.command() is None
    return bench


def test_a_tick_has_one_period():
    assert steps(standing().tick(), 1.0) is None
    assert steps(standing().tick(), 1.01) is Protection.ACCELERATION


def test_whether_a_motion_has_left_is_known_until_the_next_tick():
    bench = Bench()
    assert not bench.guard.passed
    assert bench.command(position=HOME + 1.0) is not None
    assert not bench.guard.passed
    assert bench.command() is None
    assert bench.guard.passed
    bench.tick()
    assert not bench.guard.passed


def test_a_second_command_in_the_same_tick_has_no_more_time():
    bench = standing().tick()
    assert steps(bench, 1.0) is None
    assert steps(bench, 2.0) is None  # the same tick's time, counted from the last that left
    assert steps(bench.tick(0), 3.1) is Protection.ACCELERATION


def test_after_skipped_periods_there_is_time_for_them():
    assert steps(standing().tick(5 * PERIOD), 5.0) is None
    assert steps(standing().tick(5 * PERIOD), 5.1) is Protection.ACCELERATION


def stand(bench, ticks):
    """Ask for no motion after ticks of these lengths, in periods."""
    for periods in ticks:
        assert bench.tick(round(periods * PERIOD)).command() is None
    return bench


@pytest.mark.parametrize(("ticks", "most"), [
    ([1.0], 1.0), ([1.75], 1.75), ([1.5, 0.5], 1.0), ([2.0], 2.0),
    ([20.0], 2.0), ([20.0, 1.0], 2.0), ([1.0, 0.5, 0.75], 1.0),
])  # fmt: skip
def test_time_that_a_tick_left_over_counts_up_to_one_period(ticks, most):
    assert steps(stand(standing(), ticks).tick(), most) is None
    assert steps(stand(standing(), ticks).tick(), most + 0.01) is Protection.ACCELERATION


def test_while_nothing_leaves_time_adds_up_to_what_the_loop_makes_up_for():
    assert steps(standing().tick().tick().tick(), 3.0) is None
    assert steps(standing().tick().tick().tick(), 3.01) is Protection.ACCELERATION
    for ticks, most in ((26, 26.0), (60, 26.0)):
        bench = standing()
        for _ in range(ticks):
            bench.tick()
        assert steps(bench, most) is None
        bench = standing()
        for _ in range(ticks):
            bench.tick()
        assert steps(bench, most + 0.1) is Protection.ACCELERATION


def test_with_the_drives_off_no_time_adds_up():
    bench = Bench(State.READY).tick().tick().tick()
    bench.state = State.ARMED
    way = SAFETY.bump + PANDA.limits.velocity[0] * 2e-3 * 2
    elsewhere = HOME.copy()
    elsewhere[0] += way - 1e-4
    assert bench.tick().command(position=elsewhere) is None
    bench = Bench(State.READY).tick().tick().tick()
    bench.state = State.ARMED
    elsewhere[0] = HOME[0] + way + 1e-3
    assert bench.tick().command(position=elsewhere) is Protection.BUMP


@pytest.mark.parametrize(("late", "most"), [(0, 0.5), (PERIOD // 4, 0.75), (PERIOD // 2, 1.0), (10 * PERIOD, 1.5)])
def test_a_first_tick_that_came_late_left_its_lateness_over(late, most):
    assert steps(standing(late).tick(PERIOD // 2), most) is None
    assert steps(standing(late).tick(PERIOD // 2), most + 0.01) is Protection.ACCELERATION


def test_the_number_of_motions_within_a_quarter_of_a_second_is_bounded():
    most = 188 + 50  # 1.5 times 125, and what bring-up may repeat
    bench = Bench()
    for _ in range(most):
        assert bench.frames(joint_frame(3)) is None
    assert bench.frames(joint_frame(3)) is Protection.FRAMES
    assert bench.frames(joint_frame(4)) is None
    assert bench.tick(250 * MS - 1).frames(joint_frame(3)) is Protection.FRAMES
    assert bench.tick(1).frames(joint_frame(3)) is None
    for _ in range(most - 1):
        assert bench.frames(joint_frame(3)) is None
    assert bench.tick(249 * MS).frames(joint_frame(3)) is Protection.FRAMES


@pytest.mark.parametrize("state", [State.STOPPING, State.DISABLED, State.FAULT])
def test_a_stop_is_never_too_often(state):
    bench = Bench()
    while bench.frames(joint_frame(3)) is None:
        pass
    bench.state = state
    for _ in range(1000):
        assert bench.frames(joint_frame(3, kp=0.0)) is None


def test_taking_torque_away_is_never_too_often():
    bench = Bench()
    for _ in range(1000):
        assert bench.frames(FRAMES[Kind.DISABLE]) is None


# -- power ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("watts", "refused"), [(8.1, False), (7.9, True)])
def test_the_power_of_all_joints_together_is_bounded(watts, refused):
    bench = Bench(robot=load_robot("panda", [f"safety.power={watts}"]))
    effort, velocity = np.zeros(7), np.zeros(7)
    effort[[0, 1]], velocity[[0, 1]] = (40.0, -40.0), (0.1, 0.1)
    assert bench.tick(100 * MS).command(velocity=velocity, effort=effort) is (Protection.TORQUE if refused else None)
    assert "W are allowed" in Bench(robot=load_robot("panda", ["safety.power=7.9"])).tick(100 * MS).guard.command(
        Command(CommandMode.TRACK, HOME, velocity, effort)
    )


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(("share", "refused"), [(1.0 - 2e-7, False), (1.0 + 2e-7, True)])
def test_the_time_of_a_motion_is_counted_to_the_nanosecond(first, share, refused):
    """The first motion has a period, and the next one, too."""
    bench = Bench()
    bench.command()
    bench.tick()
    if not first:
        bench.command()
        bench.tick()
    change = 1.001 * PANDA.limits.acceleration * PERIOD * 1e-9
    assert bench.command(velocity=share * change) is (Protection.ACCELERATION if refused else None)


@pytest.mark.parametrize(("more", "refused"), [(-1e-12, False), (0.5e-9, True)])
def test_the_very_first_motion_has_a_period_too(more, refused):
    """Told by how far off it may begin."""
    guard = Guard(PANDA, lambda: State.RUN)
    guard.observe(Sample(0, HOME, REST, REST, np.zeros(7, np.int64)), 0)
    start = SAFETY.bump + 1.001 * PANDA.limits.velocity[0] * PERIOD * 1e-9 + more
    text = guard.command(Command(CommandMode.TRACK, HOME + start * np.eye(7)[0], REST, REST))
    assert ("start at" in text) is refused


def test_a_turn_is_told_by_where_a_joint_is_not_by_how_fast_it_moves():
    bench = Bench()
    position, velocity = HOME.copy(), REST.copy()
    position[0], velocity[0] = 2.5, -0.9
    bench.guard.observe(Sample(PERIOD, position, velocity, REST, np.full(7, PERIOD)), PERIOD)
    frames = [joint_frame(0, position=2.5, velocity=-0.9), *(joint_frame(index) for index in range(1, 7))]
    assert bench.frames(*frames) is None
