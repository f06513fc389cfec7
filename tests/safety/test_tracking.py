"""P17 and P18: how the arm moves, on grids around every threshold."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.tracking import Drift, Overspeed, ToolSpeed, TrackingError
from robotctl.safety.trip import Category, Protection

MS = 1_000_000
STEPS = [-1e-3, -1e-9, 1e-9, 1e-3, 1.0]


def sample(position, velocity=None, stamp=7 * MS):
    rest = np.zeros(len(position))
    return Sample(
        stamp, position, rest if velocity is None else velocity, rest, np.full(len(position), stamp), (), True
    )


def one(robot, joint, value):
    values = np.zeros(robot.dof)
    values[joint] = value
    return values


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_joint_that_is_far_from_its_reference_stops_the_arm_at_once(robot: Robot, side, step):
    check = TrackingError(robot)
    rest = np.zeros(robot.dof)
    for joint, profile in enumerate(robot.profile.joints):
        led = one(robot, joint, side * (robot.profile.safety.tracking_error + step))
        trip = check.check(sample(rest), led, rest)
        assert (trip is not None) is (step > 0)
        if trip is not None:
            assert (trip.protection, trip.category, trip.onset_ns) == (Protection.TRACKING, Category.BRAKE_OFF, 7 * MS)
            assert f"{profile.name} is {robot.profile.safety.tracking_error + step:.3f} rad away" in trip.cause


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_joint_that_moves_otherwise_than_led_stops_the_arm_after_50_ms(robot: Robot, side, step):
    safety = robot.profile.safety
    rest = np.zeros(robot.dof)
    for joint, profile in enumerate(robot.profile.joints):
        check = TrackingError(robot)
        slip = safety.tracking_speed + safety.tracking_speed_share * profile.velocity + step
        led = one(robot, joint, side * slip)
        for stamp, late in [(0, False), (30, False), (49, False), (50, True), (51, True)]:
            trip = check.check(sample(rest, stamp=stamp * MS), rest, led)
            assert (trip is not None) is (late and step > 0)
        if trip is not None:
            assert (trip.protection, trip.category, trip.onset_ns) == (Protection.TRACKING, Category.BRAKE_OFF, 51 * MS)
            assert f"{profile.name} moves at 0.00 rad/s, led at {side * slip:.2f}" in trip.cause


def test_the_patience_begins_anew_when_the_joint_follows_again(panda: Robot):
    check, rest = TrackingError(panda), np.zeros(7)
    for stamp, led in [(0, 1.0), (40, 1.0), (42, 0.0), (44, 1.0), (93, 1.0)]:
        assert check.check(sample(rest, stamp=stamp * MS), rest, one(panda, 2, led)) is None
    assert check.check(sample(rest, stamp=94 * MS), rest, one(panda, 2, 1.0)) is not None


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("side", [-1, 1])
def test_an_arm_that_creeps_while_it_holds_loses_its_torque(robot: Robot, side, step):
    start = np.array(robot.profile.home)
    for joint, profile in enumerate(robot.profile.joints):
        check = Drift(robot)
        assert check.check(sample(start), holding=True) is None
        crept = start + one(robot, joint, side * (robot.profile.safety.standstill_drift + step))
        trip = check.check(sample(crept), holding=True)
        assert (trip is not None) is (step > 0)
        if trip is not None:
            assert (trip.protection, trip.category, trip.onset_ns) == (Protection.TRACKING, Category.CUT, 7 * MS)
            assert profile.name in trip.cause


def test_what_moves_between_two_holds_is_no_drift(panda: Robot):
    check, start = Drift(panda), np.zeros(7)
    check.check(sample(start), holding=True)
    assert check.check(sample(start + 1.0), holding=False) is None
    assert check.check(sample(start + 1.0), holding=True) is None


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("share", "category"),
    [(1.199, None), (1.201, Category.BRAKE_OFF), (1.499, Category.BRAKE_OFF), (1.501, Category.CUT)],
)
def test_three_samples_of_overspeed_stop_the_arm(robot: Robot, side, share, category):
    for joint, profile in enumerate(robot.profile.joints):
        check = Overspeed(robot)
        fast = sample(np.zeros(robot.dof), one(robot, joint, side * share * profile.velocity))
        assert check.check(fast) is None
        assert check.check(fast) is None
        trip = check.check(fast)
        assert (trip.category if trip else None) == category
        if trip is not None:
            assert (trip.protection, trip.onset_ns) == (Protection.OVERSPEED, 7 * MS)
            assert profile.name in trip.cause


def test_overspeed_has_to_come_in_a_row(panda: Robot):
    check, rest = Overspeed(panda), np.zeros(7)
    fast, slow = sample(rest, one(panda, 0, 1.3)), sample(rest)
    for seen in (fast, fast, slow, fast, fast):
        assert check.check(seen) is None
    assert check.check(fast) is not None


@pytest.mark.parametrize(("speed", "trips"), [(0.299, False), (0.301, True), (2.0, True)])
def test_the_tool_is_slow_during_reset_routines(panda: Robot, speed, trips):
    check = ToolSpeed(panda)
    for stamp in range(0, 102, 2):
        point = np.array([0.3, speed * stamp * 1e-3, 0.5])
        trip = check.check(point, stamp * MS, slow=True)
        assert (trip is not None) is (trips and stamp in (50, 100))
        if trip is not None:
            assert (trip.protection, trip.category) == (Protection.OVERSPEED, Category.BRAKE_OFF)
            assert trip.onset_ns == stamp * MS
            assert f"{speed:.2f} m/s" in trip.cause


def test_the_tool_may_be_fast_otherwise(panda: Robot):
    check = ToolSpeed(panda)
    assert check.check(np.zeros(3), 0, slow=True) is None
    assert check.check(np.ones(3), 60 * MS, slow=False) is None
    assert check.check(2.0 * np.ones(3), 120 * MS, slow=True) is None


def test_thresholds_come_from_the_profile():
    keys = {
        "tracking_error": 9.0, "tracking_speed": 9.0, "tracking_speed_share": 9.0, "tracking_time_s": 9.0,
        "standstill_drift": 9.0, "overspeed": 90.0, "overspeed_cut": 90.0, "reset_tool_speed": 9.0,
    }  # fmt: skip
    lax = load_robot("panda", [f"safety.{key}={value}" for key, value in keys.items()])
    rest, fast = np.zeros(7), np.full(7, 3.0)
    assert TrackingError(lax).check(sample(rest), rest + 1.0, rest) is None
    check = TrackingError(lax)
    assert check.check(sample(rest, stamp=0), rest, np.full(7, 8.0)) is None
    assert check.check(sample(rest, stamp=60 * MS), rest, np.full(7, 8.0)) is None
    drift = Drift(lax)
    drift.check(sample(rest), holding=True)
    assert drift.check(sample(rest + 1.0), holding=True) is None
    overspeed = Overspeed(lax)
    assert [overspeed.check(sample(rest, fast)) for _ in range(5)] == [None] * 5
    tool = ToolSpeed(lax)
    tool.check(np.zeros(3), 0, slow=True)
    assert tool.check(np.array([0.4, 0.0, 0.0]), 50 * MS, slow=True) is None
