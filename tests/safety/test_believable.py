"""P15: what cannot be true is not used, and stops the arm when it keeps coming."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.believable import Believable
from robotctl.safety.trip import Category, Protection

MS = 1_000_000
TICK = 2 * MS


def sample(stamp, position, velocity=0.0, effort=0.0, rejected=0, stamps=None):
    fill = np.full(7, 1.0)
    stamps = np.full(7, stamp) if stamps is None else stamps
    return Sample(stamp, np.asarray(position, float), velocity * fill, effort * fill, stamps, (), True, None, rejected)


def moved(panda, joint, way):
    position = np.array(panda.profile.home)
    position[joint] += way
    return position


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("step", "believed"), [(-1e-6, True), (1e-6, False), (1.0, False), (np.nan, False), (np.inf, False)]
)
def test_a_joint_cannot_jump(panda: Robot, joint, side, step, believed):
    screen = Believable(panda)
    home = np.array(panda.profile.home)
    screen.screen(sample(0, home, 0.1, 0.2))
    reach = 3.0 * panda.limits.velocity[joint] * 2e-3 + 0.01
    seen = screen.screen(sample(TICK, moved(panda, joint, side * (reach + step)), 0.3, 0.4))
    for other in range(7):
        kept = other != joint or believed
        assert seen.velocity[other] == (0.3 if kept else 0.1)
        assert seen.effort[other] == (0.4 if kept else 0.2)
        assert seen.joint_stamp_ns[other] == (TICK if kept else 0)
    assert seen.position[joint] == (home[joint] + side * (reach + step) if believed else home[joint])
    assert seen.stamp_ns == TICK


@pytest.mark.parametrize("velocity", [np.nan, np.inf])
def test_a_speed_that_is_no_number_is_not_believed(panda: Robot, velocity):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home, 0.1))
    assert (screen.screen(sample(TICK, panda.profile.home, velocity)).velocity == 0.1).all()


def test_the_way_allowed_grows_with_the_time_since_the_joint_was_heard_of(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home))
    far = moved(panda, 0, 3.0 * panda.limits.velocity[0] * 40e-3)
    assert screen.screen(sample(40 * MS, far)).position[0] == far[0]


def test_what_was_not_believed_stays_the_measure_of_what_comes(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home))
    for tick in range(1, 4):
        assert screen.screen(sample(tick * TICK, moved(panda, 2, 1.0))).position[2] == panda.profile.home[2]
    assert screen.check(4 * TICK) is None
    assert screen.screen(sample(4 * TICK, panda.profile.home)).joint_stamp_ns[2] == 4 * TICK


def jump(screen, panda, count, begin=1, every=1):
    for tick in range(begin, begin + count * every, every):
        screen.screen(sample(tick * TICK, moved(panda, 5, 1.0)))
    return tick * TICK


def test_five_within_a_second_stop_the_arm(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home))
    last = jump(screen, panda, 4)
    assert screen.check(last) is None
    last = jump(screen, panda, 1, begin=5)
    trip = screen.check(last)
    assert (trip.protection, trip.category, trip.onset_ns) == (Protection.RECEIVE, Category.BRAKE_OFF, last)
    assert "5 measurements within 1 s" in trip.cause
    assert "panda_joint6 at 2.900 rad after 1.900" in trip.cause


@pytest.mark.parametrize(("age", "trips"), [(1000 * MS, True), (1000 * MS + 1, False)])
def test_older_ones_are_forgotten(panda: Robot, age, trips):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home))
    jump(screen, panda, 5)
    assert (screen.check(TICK + age) is not None) is trips


@pytest.mark.parametrize(("rejected", "trips"), [(0, False), (4, False), (5, True), (10**12, True)])
def test_frames_that_make_no_sense_count_too(panda: Robot, rejected, trips):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home, rejected=100))
    screen.screen(sample(TICK, panda.profile.home, rejected=100 + rejected))
    trip = screen.check(TICK)
    assert (trip is not None) is trips
    if trip is not None:
        assert "without sense" in trip.cause
        assert trip.onset_ns == TICK
    screen.screen(sample(2 * TICK, panda.profile.home, rejected=100 + rejected))
    assert (screen.check(2 * TICK) is not None) is trips


def test_one_new_reject_each_tick_adds_up(panda: Robot):
    screen = Believable(panda)
    for tick in range(5):
        screen.screen(sample(tick * TICK, panda.profile.home, rejected=tick))
        assert screen.check(tick * TICK) is None
    screen.screen(sample(5 * TICK, panda.profile.home, rejected=5))
    assert screen.check(5 * TICK) is not None


def test_the_first_measurement_counts_once_it_is_a_number(panda: Robot):
    screen = Believable(panda)
    unheard = np.full(7, np.nan)
    assert np.isnan(screen.screen(sample(0, unheard)).position).all()
    assert (screen.screen(sample(TICK, panda.profile.home)).position == panda.profile.home).all()
    assert (screen.screen(sample(2 * TICK, moved(panda, 0, 1.0))).position == panda.profile.home).all()


def test_what_is_forgotten_is_no_measure(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home))
    last = jump(screen, panda, 5)
    screen.forget()
    assert screen.check(last) is None
    assert screen.screen(sample(last, moved(panda, 0, 2.0))).position[0] == panda.profile.home[0] + 2.0


def test_the_number_comes_from_the_profile():
    robot = load_robot("panda", ["safety.rejected_frames=2"])
    screen = Believable(robot)
    screen.screen(sample(0, robot.profile.home))
    assert screen.check(jump(screen, robot, 1)) is None
    assert screen.check(jump(screen, robot, 1, begin=2)) is not None


def test_a_first_sample_with_anything_that_is_no_number_is_not_kept(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, moved(panda, 3, np.nan)))
    assert (screen.screen(sample(TICK, panda.profile.home)).position == panda.profile.home).all()


def test_a_jump_is_measured_from_the_sample_before_however_long_the_arm_runs(panda: Robot):
    screen = Believable(panda)
    for stamp in (10**9, 2 * 10**9):
        screen.screen(sample(stamp, panda.profile.home))
    seen = screen.screen(sample(2 * 10**9 + TICK, moved(panda, 3, 1.0)))
    assert seen.position[3] == panda.profile.home[3]


def test_samples_without_complaint_do_not_change_the_cause(panda: Robot):
    screen = Believable(panda)
    screen.screen(sample(0, panda.profile.home, rejected=4))
    for number in range(1, panda.profile.safety.rejected_frames + 1):
        screen.screen(sample(number * TICK, moved(panda, 3, 1.0), rejected=4))
    for rejected in (4, 3):
        screen.screen(sample(9 * TICK, panda.profile.home, rejected=rejected))
        assert "panda_joint4" in screen.check(9 * TICK).cause
