"""The box on joint velocities: where it looks at a limit. What it allows is in test_shaper_on_a_slide.py."""

import numpy as np
import pytest

from robotctl.hal.robot import load_robot
from robotctl.safety.box import JointBox


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize(("left", "looked_at"), [(1e-9, False), (-1e-9, True)])
def test_a_limit_is_looked_at_only_where_braking_from_the_cap_could_reach_it(monkeypatch, side, share, left, looked_at):
    robot, dt = load_robot("panda"), 0.002
    box, rest = JointBox(robot, dt, 0.9, brake_share=share), np.zeros(7)
    looked: list[np.ndarray] = []
    monkeypatch.setattr(box, "_position_bound", lambda mirrored: looked.append(mirrored) or np.ones(14))
    for joint in range(7):
        cap, brake = 0.9 * robot.limits.velocity[joint], 0.9 * share * robot.limits.acceleration[joint]
        edge = robot.limits.upper[joint] if side > 0 else -robot.limits.lower[joint]
        position = 0.5 * (robot.limits.upper + robot.limits.lower)
        way = 0.5 * cap * dt + cap**2 / (2.0 * brake)
        position[joint] = side * (edge - robot.profile.safety.position_margin - way - left)
        looked.clear()
        box.bounds(position, rest)
        assert bool(looked) is looked_at


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("past", "share"), [(0.001, 0.02 / 0.9), (0.0049, 0.098 / 0.9), (0.006, 0.1), (0.5, 0.1)])
def test_a_joint_past_its_edge_is_led_back_in_proportion_up_to_a_tenth_of_its_cap(side, past, share):
    """At 20 times the excess, for a cap of 0.9 rad/s and for others in the same proportion."""
    robot = load_robot("panda", [f"joints.{joint}.acceleration=1e6" for joint in range(7)])
    for joint, cap in enumerate(0.9 * robot.limits.velocity):
        box = JointBox(robot, 0.002, 0.9, pull=20.0 * cap / 0.9)
        position = 0.5 * (robot.limits.upper + robot.limits.lower)
        edge = robot.limits.upper[joint] if side > 0 else -robot.limits.lower[joint]
        position[joint] = side * (edge - robot.profile.safety.position_margin + past)
        lower, upper = box.bounds(position, np.zeros(7))
        assert (upper if side > 0 else -lower)[joint] == pytest.approx(-min(share, 0.1) * cap)
