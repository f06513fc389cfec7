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
