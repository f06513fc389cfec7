"""Limiter and shaper together: long hostile runs on the reference."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip, Shaper


@pytest.mark.parametrize("policy", ["random", "outward", "bang"])
@pytest.mark.parametrize(("sphere", "furnished"), [("qp", False), ("projection", False), ("qp", True)])
def test_hostile_wishes_keep_every_invariant(
    robot: Robot, policy: str, sphere: str, furnished: bool, keep_outs
) -> None:
    settings = [keep_outs(robot)] if furnished else []
    robot = load_robot(robot.profile.name, [f"safety.sphere={sphere}", *settings])
    kinematics = Kinematics(robot)
    limiter, shaper, limits = VelocityLimiter(robot), Shaper(robot, kinematics), robot.limits
    rng = np.random.default_rng(11)
    full, centre, dt = regions(robot.profile), np.array(robot.profile.sphere.centre), robot.period_ns * 1e-9
    position, velocity, acceleration = np.array(robot.profile.home), np.zeros(robot.dof), np.zeros(robot.dof)
    wish = np.zeros(robot.dof)
    clipped = Clip.NONE
    for tick in range(4000):
        tool, jacobian = kinematics.tool_and_jacobian(position)
        if tick % (25 if policy != "bang" else 250) == 0:
            if policy == "random":
                wish = rng.uniform(-2.0, 2.0, robot.dof) * limits.velocity
            elif policy == "bang":
                wish = rng.choice([-10.0, 0.0, 10.0], robot.dof) * limits.velocity
            else:
                push = jacobian.T @ (tool - centre)
                wish = 2.0 * np.where(np.abs(push) > 0.01, np.sign(push), 1.0) * limits.velocity
        limited = limiter.step(wish, velocity, acceleration)
        following, clip = shaper.step(position, velocity, limited, tool, jacobian)
        clipped |= clip
        acceleration = (following - velocity) / dt
        position = position + 0.5 * dt * (velocity + following)
        velocity = following
        assert (position <= limits.upper).all()
        assert (position >= limits.lower).all()
        assert (np.abs(velocity) <= limits.velocity).all()
        assert (np.abs(acceleration) <= limits.acceleration).all()
        assert all(region.room(kinematics.tool(position)) >= 0.0 for region in full)
    # Something came near a bound, else nothing was tested. Outward is a ray, which leaves by whichever bound is first;
    # the projection rule leaves most to the predicted stop.
    bounds = Clip.KEEP_OUT | (Clip.SPHERE if policy == "outward" else Clip.NONE) if furnished else Clip.SPHERE
    assert clipped & (Clip.PREDICTED_STOP if sphere == "projection" else bounds)
