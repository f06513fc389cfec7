"""P25: profiles that must not be loaded."""

from collections.abc import Callable
from typing import Any

from pydantic import ValidationError

from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import RobotProfile
from robotctl.hal.robot import Robot, load_robot
from robotctl.trials.refusals import refusal_scenario
from robotctl.trials.scenario import Scenario, Trial

_LIMITS = ("velocity", "acceleration", "jerk", "torque", "torque_rate")
_SPOILT = (float("nan"), float("inf"), -1.0, 0.0, True, "1.0", None)
_SPOILT_RANGES = ((1.0, -1.0), (float("nan"), 1.0), (0.0,), (1.0, 1.0))
_WIDER = 100.0


def _with(*overrides: str) -> Callable[[Robot, str, int], None]:
    """Return the attempt to load a profile with other values."""

    def attempt(robot: Robot, _backend: str, _seed: int) -> None:
        load_robot(str(robot.source), overrides)

    return attempt


def _every_limit(robot: Robot, _backend: str, _seed: int) -> Trial:
    """Spoil every limit of every joint."""
    trial, refused = Trial(), 0
    for joint in range(robot.dof):
        spoilt: list[tuple[str, Any]] = [(limit, value) for limit in _LIMITS for value in _SPOILT]
        spoilt += [("position", pair) for pair in _SPOILT_RANGES]
        for key, value in spoilt:
            data = robot.profile.model_dump()
            data["joints"][joint][key] = value
            refused += _is_refused(data, f"joint {joint}: {key} {value!r}", trial)
        data = robot.profile.model_dump()
        del data["joints"][joint]["velocity"]
        refused += _is_refused(data, f"joint {joint} without a velocity cap", trial)
    trial.seen = f"{refused} of {refused + len(trial.problems)} refused"
    return trial


def _is_refused(data: dict[str, Any], what: str, trial: Trial) -> bool:
    try:
        RobotProfile.model_validate(data)
    except ValidationError:
        return True
    return trial.require(False, f"{what} was accepted")


def _wider_than_model(robot: Robot, _backend: str, _seed: int) -> Trial:
    """Widen every limit that the model or the motor knows."""
    trial, refused = Trial(), 0
    for index, joint in enumerate(robot.profile.joints):
        model = robot.description.limits[joint.name]
        wider = [f"position=[{joint.position[0]}, {model.upper + 0.1}]", f"position=[{model.lower - 0.1}, 0.5]"]
        wider += [f"velocity={_WIDER * joint.velocity}", f"torque={_WIDER * joint.torque}"]
        for what in wider:
            try:
                load_robot(str(robot.source), [f"joints.{index}.{what}"])
            except ConfigError:
                refused += 1
            else:
                trial.require(False, f"{joint.name}: {what} was accepted")
    trial.seen = f"{refused} of {refused + len(trial.problems)} refused"
    return trial


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    name = robot.profile.joints[0].name
    return [
        Scenario(
            25, "spoilt limits", "every limit of every joint: NaN, negative, text, missing", "refused", _every_limit, 1
        ),
        Scenario(25, "wider than the model", "every limit beyond model or motor", "refused", _wider_than_model, 1),
        refusal_scenario(
            25, "unknown key", "a key that is not known", _with("safety.sphere_gian=1.0"), ["unknown key"]
        ),
        refusal_scenario(
            25, "home outside", "a home beyond a soft limit", _with("home.0=100.0"), [name, "outside its limits"]
        ),
    ]
