"""P19: the arm is pushed, and meets something."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted, pushed, walled
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import tolerated_scenario
from robotctl.trials.stops import Expected, still, stop_scenario

_PUSH = 1.4
"""Multiple of the torque that counts as contact."""
_PUSH_S = 0.06
_OBSERVED_S = 0.02
"""What the observer takes to see most of a torque."""
_STIFF = 3000.0
_SOFT = 15.0
"""Nm/rad; less than the drives' own."""
_WALL_S = 0.5
_SETTLE_S = 3.0


def _push(bench: Bench) -> Planted:
    """Somebody pushes the joint that is heaviest for the torque that counts as contact: it does not race off."""
    least = bench.robot.profile.safety.contact * bench.robot.limits.torque
    inertia = np.diag(bench.loop.kinematics.mass_matrix(bench.plant.truth().position))
    torque = np.zeros(bench.robot.dof)
    axis = int((inertia / least).argmax())
    torque[axis] = bench.random.choice([-_PUSH, _PUSH]) * least[axis]
    return pushed(bench, torque, _PUSH_S)


def _against(bench: Bench, stiffness: float) -> Planted:
    """Something stands in the way of the joint that moves fastest of the stronger ones."""
    limits = bench.robot.limits
    speed = np.abs(bench.plant.truth().velocity) / limits.velocity
    axis = int(np.where(limits.torque >= np.median(limits.torque), speed, -1.0).argmax())
    return walled(bench, axis, stiffness, _WALL_S)


def _wall(bench: Bench) -> Planted:
    return _against(bench, _STIFF)


def _cushion(bench: Bench) -> Planted:
    return _against(bench, _SOFT)


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    patience = robot.profile.safety.contact_time_s
    touched = Expected(
        protection=Protection.CONTACT,
        category=Category.BRAKE_HOLD,
        within_s=patience + _OBSERVED_S,
        rest_s=_SETTLE_S,
        excused=frozenset({"velocity", "drift"}),  # it gives way for as long as it is pushed
    )
    # A short blow may be over before it counts as contact; then it shows in how the arm moves.
    struck = Expected(
        protection=Protection.CONTACT,
        category=Category.BRAKE_HOLD,
        within_s=0.1,
        or_else=((Protection.TRACKING, Category.BRAKE_OFF), (Protection.OVERSPEED, Category.BRAKE_OFF)),
        rest_s=_SETTLE_S,
        excused=frozenset({"velocity", "position", "sphere", "drift"}),
    )
    return [
        stop_scenario(
            19, "pushed", f"somebody pushes an arm at rest for {1e3 * _PUSH_S:.0f} ms", _push, touched, still
        ),
        stop_scenario(19, "wall", "the arm runs into a wall", _wall, struck),
        tolerated_scenario(19, "cushion", "the arm runs into a cushion", _cushion, frozenset({"velocity"})),
    ]
