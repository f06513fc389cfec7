"""P19: the arm is pushed, and meets something."""

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.contact import ContactReflex
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted, pushed, resisted
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import tolerated_scenario
from robotctl.trials.stops import Expected, running, still, stop_scenario

_PUSH = 1.5
"""Multiple of the torque that counts as contact."""
_PUSH_S = 0.06
_OBSERVED_S = 0.03
"""What the observer takes to see most of a torque."""
_STIFF = 3000.0
"""Nm/rad"""
_DRAG = 0.15
"""Share of the torque that counts as contact, at a velocity cap."""
_IN_THE_WAY_S = 0.5
_SETTLE_S = 3.0
_SWING_S = 6.0
"""An arm of soft gains swings on them after it has run into something."""
_FAST = 0.7
"""Share of a velocity cap."""


def _least(robot: Robot) -> Vector:
    """Return the torques (n,) that count as contact, Nm."""
    return ContactReflex(robot).threshold


def _heaviest(robot: Robot) -> tuple[int, float]:
    """Return the joint that a contact sets in motion most slowly, and its inertia at home, kg m^2."""
    inertia = np.diag(Kinematics(robot).mass_matrix(np.array(robot.profile.home)))
    axis = int((inertia / _least(robot)).argmax())
    return axis, float(inertia[axis])


def _races(robot: Robot) -> bool:
    """Return whether a joint that is pushed is too fast (P18) before that counts as contact."""
    axis, inertia = _heaviest(robot)
    fastest = robot.profile.safety.overspeed * float(robot.limits.velocity[axis])
    patience = robot.profile.safety.contact_time_s + _OBSERVED_S
    return fastest * inertia < patience * _PUSH * float(_least(robot)[axis])


def _push(bench: Bench) -> Planted:
    """Somebody pushes the joint that races off least."""
    axis, _ = _heaviest(bench.robot)
    torque = np.zeros(bench.robot.dof)
    torque[axis] = bench.random.choice([-_PUSH, _PUSH]) * _least(bench.robot)[axis]
    return pushed(bench, torque, _PUSH_S)


def _speeds(bench: Bench) -> np.ndarray:
    """Return the speeds of the stronger joints as shares of their caps; of the others -1."""
    limits = bench.robot.limits
    speed = np.abs(bench.plant.truth().velocity) / limits.velocity
    return np.where(limits.torque >= np.median(limits.torque), speed, -1.0)


def _at_speed(bench: Bench) -> None:
    running(bench)
    bench.until(lambda: bool(_speeds(bench).max() > _FAST), 2.0)


def _wall(bench: Bench) -> Planted:
    return resisted(bench, int(_speeds(bench).argmax()), _STIFF, 0.0, _IN_THE_WAY_S)


def _drag(bench: Bench) -> Planted:
    axis = int(_speeds(bench).argmax())
    return resisted(
        bench, axis, 0.0, _DRAG * _least(bench.robot)[axis] / bench.robot.limits.velocity[axis], _IN_THE_WAY_S
    )


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    patience = robot.profile.safety.contact_time_s
    touched = Expected(
        protection=Protection.CONTACT,
        category=Category.BRAKE_HOLD,
        within_s=patience + _OBSERVED_S,
        rest_s=_SETTLE_S,
        or_else=((Protection.OVERSPEED, Category.BRAKE_OFF),) if _races(robot) else (),
        excused=frozenset({"velocity", "drift"}),  # it gives way for as long as it is pushed
    )
    # A short blow may be over before it counts as contact; then it shows in how the arm moves.
    struck = Expected(
        protection=Protection.CONTACT,
        category=Category.BRAKE_HOLD,
        within_s=0.1,
        or_else=((Protection.TRACKING, Category.BRAKE_OFF), (Protection.OVERSPEED, Category.BRAKE_OFF)),
        rest_s=_SWING_S,
        excused=frozenset({"velocity", "position", "sphere", "drift"}),
    )
    return [
        stop_scenario(
            19, "pushed", f"somebody pushes an arm at rest for {1e3 * _PUSH_S:.0f} ms", _push, touched, still
        ),
        stop_scenario(19, "wall", "the arm runs into a wall", _wall, struck, _at_speed),
        tolerated_scenario(19, "drag", "something drags at the arm under way", _drag, frozenset({"velocity"})),
    ]
