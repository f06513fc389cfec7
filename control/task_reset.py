"""R3: a task's reset as data, a list of steps in its YAML, e.g. to shut a door and to carry an object back.

    reset:
      - {pose: [0.0, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785]}    # joints, rad
      - {tool: [0.5, 0.1, 0.3]}                            # the tool straight to a point of the base frame, m
      - {grip: 0.02, force: 10.0}                          # the fingers to an opening, m, with at most a force, N
      - {push: [0.65, 0.0, 0.45], force: 15.0}             # slowly to a point, or until it takes the force

Each step is a reset routine: run in RESET, through limiter, shaper and guard, at reduced caps; tried three times, and
then the operator is needed.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Tag, TypeAdapter

from robotctl.control.kinematics import Kinematics
from robotctl.control.task_routines import Grip, Push, ToolTo
from robotctl.hal.arm import Gripper
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import Finite, NotNegative, Point, Positive
from robotctl.hal.robot import Robot
from robotctl.safety.routines import Goto, Routine


class _Step(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class PoseStep(_Step):
    """Lead the joints straight to a pose."""

    pose: list[Finite]
    """rad"""


class ToolStep(_Step):
    """Lead the tool straight to a point of the base frame."""

    tool: Point
    """m"""


class GripStep(_Step):
    """Open or close the gripper."""

    grip: NotNegative
    """Opening, m."""
    force: Positive
    """N"""


class PushStep(_Step):
    """Lead the tool slowly towards a point of the base frame, until it is there or it takes a force."""

    push: Point
    """m"""
    force: Positive
    """N"""


_STEPS = {"pose": PoseStep, "tool": ToolStep, "grip": GripStep, "push": PushStep}


def _kind(step: Any) -> str | None:
    keys = step if isinstance(step, Mapping) else type(step).model_fields
    return next((kind for kind in _STEPS if kind in keys), None)


Step = Annotated[
    Annotated[PoseStep, Tag("pose")]
    | Annotated[ToolStep, Tag("tool")]
    | Annotated[GripStep, Tag("grip")]
    | Annotated[PushStep, Tag("push")],
    Discriminator(_kind, custom_error_type="step", custom_error_message="a step has one of pose, tool, grip and push"),
]
_LIST: TypeAdapter[list[Step]] = TypeAdapter(list[Step])


def dump(steps: Sequence[Step]) -> list[dict[str, Any]]:
    """Return steps in terms of JSON."""
    return [step.model_dump() for step in steps]


def parse(steps: Sequence[Mapping[str, Any]]) -> list[Step]:
    """Return what `dump` was given."""
    return _LIST.validate_python(steps)


class TaskReset:
    """The steps of a task for one arm."""

    def __init__(self, robot: Robot, kinematics: Kinematics, gripper: Gripper | None, steps: Sequence[Step]) -> None:
        """Take the steps.

        Raises:
            ConfigError: if one of them is nothing that this robot could do.
        """
        self._robot = robot
        self._kinematics = kinematics
        self._gripper = gripper
        self._steps = list(steps)
        self.routines()

    def routines(self) -> list[Routine]:
        """Return the routines that do it, made anew."""
        return [self._routine(step, index) for index, step in enumerate(self._steps)]

    def _routine(self, step: Step, index: int) -> Routine:
        robot, kinematics, gripper = self._robot, self._kinematics, self._gripper
        name = f"task reset, step {index} ({_kind(step)})"
        match step:
            case PoseStep(pose=pose):
                if len(pose) != robot.dof:
                    raise ConfigError(f"{name}: {len(pose)} values for the {robot.dof} joints of {robot.profile.name}")
                return Goto(robot, np.array(pose), name, kinematics)
            case ToolStep(tool=point):
                return ToolTo(robot, kinematics, np.array(point), name)
            case PushStep(push=point, force=force):
                return Push(robot, kinematics, np.array(point), force, name)
            case GripStep(grip=width, force=force):
                profile = robot.profile.gripper
                if gripper is None or profile is None:
                    raise ConfigError(f"{name}: {robot.profile.name} has no gripper")
                if width > profile.width or force > profile.force:
                    limits = f"{profile.width} m and {profile.force} N"
                    raise ConfigError(f"{name}: {width} m with {force} N; the gripper does {limits} at most")
                return Grip(robot, gripper, width, force, name)
