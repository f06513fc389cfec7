"""Each protection by itself, on a grid around its threshold."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.protections import FeedbackAge, PositionBreach, SphereBreach
from robotctl.safety.stoppable import StoppableMotion
from robotctl.safety.trip import Category, Protection

STEPS = [-1e-3, -1e-6, -1e-9, 1e-9, 1e-6, 1e-3, 1.0]
STAMP = 7_000_000


def sample(position, **fields):
    zero = np.zeros(len(position))
    stamps = fields.pop("stamps", np.full(len(position), STAMP))
    return Sample(STAMP, position, zero, zero, stamps, **({"enabled": True} | fields))


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("side", [-1, 1])
def test_position(robot: Robot, side, step):
    check = PositionBreach(robot)
    limit = robot.limits.upper if side > 0 else robot.limits.lower
    for joint in range(robot.dof):
        position = np.array(robot.profile.home)
        position[joint] = limit[joint] + side * (robot.profile.safety.position_breach + step)
        trip = check.check(sample(position))
        assert (trip is not None) is (step > 0)
        if trip is not None:
            assert (trip.protection, trip.category, trip.onset_ns) == (Protection.POSITION, Category.BRAKE_OFF, STAMP)
            assert f"{robot.profile.joints[joint].name} measured at {position[joint]:.3f} rad" in trip.cause


def test_the_worst_joint_is_named(panda: Robot):
    position = np.array(panda.limits.upper) + np.array([0.0, 0.1, 0.0, 0.0, 0.3, 0.0, 0.0])
    assert "panda_joint5" in PositionBreach(panda).check(sample(position)).cause


def test_inside_means_the_soft_limit_itself(robot: Robot):
    check = PositionBreach(robot)
    assert check.inside(np.array(robot.limits.lower))
    assert check.inside(np.array(robot.limits.upper))
    for joint in range(robot.dof):
        for limit, side in ((robot.limits.lower, -1), (robot.limits.upper, 1)):
            position = np.array(limit)
            position[joint] = np.nextafter(limit[joint], side * np.inf)
            assert not check.inside(position)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, -0.8)])
def test_sphere(robot: Robot, direction, step):
    check = SphereBreach(robot)
    sphere = robot.profile.sphere
    tool = np.array(sphere.centre) + (sphere.radius + robot.profile.safety.sphere_breach + step) * np.array(direction)
    assert check.outside(tool) == pytest.approx(robot.profile.safety.sphere_breach + step)
    trip = check.check(tool, STAMP)
    assert (trip is not None) is (step > 0)
    if trip is not None:
        assert (trip.protection, trip.category, trip.onset_ns) == (Protection.SPHERE, Category.BRAKE_HOLD, STAMP)
        assert f"{1e3 * (robot.profile.safety.sphere_breach + step):.0f} mm past the bound of 'sphere'" in trip.cause


@pytest.mark.parametrize("step", STEPS)
def test_keep_outs_are_breached_like_the_sphere(step):
    robot = load_robot("panda", ["keep_out=[{kind: plane, name: table, point: [0, 0, 0.3], normal: [0, 0, 1]}]"])
    check = SphereBreach(robot)
    tool = np.array([0.45, 0.0, 0.3 - robot.profile.safety.sphere_breach - step])
    assert check.outside(tool) == pytest.approx(robot.profile.safety.sphere_breach + step)
    trip = check.check(tool, STAMP)
    assert (trip is not None) is (step > 0)
    if trip is not None:
        assert (trip.protection, trip.category, trip.onset_ns) == (Protection.SPHERE, Category.BRAKE_HOLD, STAMP)
        assert f"{1e3 * (robot.profile.safety.sphere_breach + step):.0f} mm past the bound of 'table'" in trip.cause


def test_the_spheres_breach_is_measured_from_the_full_radius_not_from_the_shapers(panda: Robot):
    centre = np.array(panda.profile.sphere.centre)
    assert SphereBreach(panda).outside(centre + np.array([0.0, 0.0, panda.profile.sphere.radius])) == pytest.approx(
        0.0, abs=1e-12
    )
    assert SphereBreach(panda).outside(centre) == -panda.profile.sphere.radius


@pytest.mark.parametrize("joint", range(7))
def test_feedback_age(panda: Robot, joint):
    safety = panda.profile.safety
    check = FeedbackAge(panda)
    stop, fault = round(safety.feedback_stop_s * 1e9), round(safety.feedback_fault_s * 1e9)
    now = 10**9
    for age, stale, trips in [
        (0, False, False),
        (stop, False, False),
        (stop + 1, True, False),
        (fault, True, False),
        (fault + 1, True, True),
        (0, False, False),
    ]:
        stamps = np.full(7, now)
        stamps[joint] -= age
        trip = check.check(sample(np.zeros(7), stamps=stamps), now)
        assert check.stale is stale
        assert (trip is not None) is trips
        if trip is not None:
            assert (trip.protection, trip.category) == (Protection.FEEDBACK, Category.BRAKE_OFF)
            assert trip.onset_ns == now - age + fault
            assert f"{panda.profile.joints[joint].name} has not answered for 50 ms" in trip.cause


def test_before_the_first_sample_nothing_is_missed(panda: Robot):
    check = FeedbackAge(panda)
    assert (check.stale, check.lost, check.dead) == (False, False, False)


@pytest.mark.parametrize(("later", "dead"), [(0, False), (1, True)])
def test_drives_are_dead_when_the_last_one_has_been_silent_for_too_long(panda: Robot, later, dead):
    check = FeedbackAge(panda)
    now = 10**9
    stamps = np.full(7, 0)
    stamps[4] = now - round(panda.profile.safety.feedback_fault_s * 1e9) - later
    check.check(sample(np.zeros(7), stamps=stamps), now)
    assert check.lost
    assert check.dead is dead


def test_joints_behind_a_lost_bus_are_not_waited_for_and_the_others_are(panda: Robot):
    check = FeedbackAge(panda)
    now = 10**9
    stamps = np.full(7, now)
    stamps[[1, 5]] = 0
    assert check.check(sample(np.zeros(7), stamps=stamps, cut_off=(1, 5)), now) is None
    assert (check.stale, check.lost, check.dead) == (False, False, False)
    assert stamps[1] == 0
    stamps[3] = 0
    trip = check.check(sample(np.zeros(7), stamps=stamps, cut_off=(1, 5)), now)
    assert trip is not None
    assert panda.profile.joints[3].name in trip.cause


@pytest.mark.parametrize("key", ["position_breach", "sphere_breach"])
def test_thresholds_come_from_the_profile(key):
    """At a distance of 0.4 both trip by default, and none with a threshold of 0.5."""
    for robot, trips in ((load_robot("panda"), True), (load_robot("panda", [f"safety.{key}=0.5"]), False)):
        rest = np.array(robot.profile.home)
        beyond = rest.copy()
        beyond[0] = robot.limits.upper[0] + 0.4
        outside = np.array(robot.profile.sphere.centre) + np.array([robot.profile.sphere.radius + 0.4, 0.0, 0.0])
        found = {
            "position_breach": PositionBreach(robot).check(sample(beyond)),
            "sphere_breach": SphereBreach(robot).check(outside, 0),
        }[key]
        assert (found is not None) is trips


@pytest.mark.parametrize("field", ["position", "velocity"])
def test_a_measurement_that_is_no_number_is_never_fine(field: str) -> None:
    robot = load_robot("panda")
    home = np.array(robot.profile.home)
    sample = Sample(0, home, np.zeros(7), np.zeros(7), np.zeros(7, np.int64), (), True)
    bad = np.array(getattr(sample, field))
    bad[3] = np.nan
    sample = sample._replace(**{field: bad})
    assert StoppableMotion(robot, Kinematics(robot)).check(sample.position, sample.velocity, 0) is not None
    if field == "position":
        assert PositionBreach(robot).check(sample) is not None
        assert SphereBreach(robot).check(np.array([np.nan, 0.0, 0.0]), 0) is not None
