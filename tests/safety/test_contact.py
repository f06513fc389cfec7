"""P19: torques from outside."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.contact import ContactReflex
from robotctl.safety.trip import Category, Protection

MS = 1_000_000


def least(robot, joint):
    """0.15 rad off its track, or the torque cap."""
    profile = robot.profile.joints[joint]
    return min(0.15 * profile.gains.kp, profile.torque)


def feel(robot, joint, share):
    external = np.zeros(robot.dof)
    external[joint] = share * least(robot, joint)
    return external


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("share", "touched"), [(0.599, False), (0.601, True), (2.0, True)])
def test_a_torque_above_its_threshold_for_20_ms_is_contact(robot: Robot, side, share, touched):
    for joint, profile in enumerate(robot.profile.joints):
        reflex = ContactReflex(robot)
        for stamp, late in [(0, False), (10, False), (19, False), (20, True)]:
            trip = reflex.check(feel(robot, joint, side * share), stamp * MS)
            assert reflex.touched is touched
            assert (trip is not None) is (touched and late)
        if trip is not None:
            assert (trip.protection, trip.category, trip.onset_ns) == (Protection.CONTACT, Category.BRAKE_HOLD, 20 * MS)
            assert f"{profile.name} feels {side * share * least(robot, joint):.1f} Nm" in trip.cause


def test_before_the_first_sample_nothing_touches(panda: Robot):
    assert ContactReflex(panda).touched is False


def test_a_knock_that_ends_in_time_is_none(panda: Robot):
    reflex = ContactReflex(panda)
    for stamp, share in [(0, 1.0), (18, 1.0), (19, 0.0), (20, 1.0), (39, 1.0)]:
        assert reflex.check(feel(panda, 2, share), stamp * MS) is None
    assert reflex.check(feel(panda, 2, 1.0), 40 * MS) is not None
    reflex.check(feel(panda, 2, 0.0), 42 * MS)
    assert not reflex.touched


def test_thresholds_come_from_the_profile():
    settings = ["safety.contact=0.5", "safety.tracking_error=0.3", "safety.contact_time_s=0.1"]
    robot = load_robot("panda", settings)
    reflex = ContactReflex(robot)
    assert reflex.threshold == pytest.approx([18.0, 18.0, 15.0, 15.0, 6.0, 6.0, 4.5])  # of 5 to 7 half the cap is less
    for threshold, felt in ((0.99, False), (1.01, True)):
        reflex.check(threshold * reflex.threshold, 0)
        assert reflex.touched is felt
    assert reflex.check(1.01 * reflex.threshold, 99 * MS) is None
    assert reflex.check(1.01 * reflex.threshold, 100 * MS) is not None
