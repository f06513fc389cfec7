"""Tasks as data, and the goal of each episode."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from robotctl.control.kinematics import Kinematics
from robotctl.control.task_reset import Step
from robotctl.hal.document import read_document
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import CONFIGS, Robot
from robotctl.hal.types import Vector
from robotctl.safety.region import regions

_ATTEMPTS = 1000


class ReachTask(BaseModel):
    """Bring the tool to a target point."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    name: str
    steps: Annotated[int, Field(ge=1)]
    """Longest episode, policy steps."""
    policy_hz: Annotated[int, Field(ge=1, le=100)]
    cube: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """Side of the cube of targets around the tool's home position, m."""
    success: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """Distance within which an episode counts as a success, m."""
    settled: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """An episode ends early once the tool stays this close, m ..."""
    settled_steps: Annotated[int, Field(ge=1)]
    """... for this many policy steps."""
    reset: list[Step] = []
    """Steps that set the scene right before every episode; see `control.task_reset`."""

    def goal(self, robot: Robot, kinematics: Kinematics, seed: int, episode: int) -> Vector:
        """Return the target point (3,) of one episode, the same for the same seed.

        Raises:
            ConfigError: if the robot's sphere and keep-outs leave no room for the cube.
        """
        rng = np.random.default_rng((seed, episode))
        home = kinematics.tool(np.array(robot.profile.home))
        allowed = regions(robot.profile, self.success)
        for _ in range(_ATTEMPTS):
            goal: Vector = home + rng.uniform(-0.5 * self.cube, 0.5 * self.cube, 3)
            if all(region.room(goal) > 0.0 for region in allowed):
                return goal
        raise ConfigError(f"{robot.source}: sphere and keep-outs leave no room for the targets of task {self.name!r}")


def load_task(name: str) -> ReachTask:
    """Load a task by name or by the path of its file.

    Raises:
        ConfigError: if there is no such task, or its file is malformed.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = CONFIGS / "tasks" / f"{name}.yaml"
        if not path.is_file():
            known = sorted(entry.stem for entry in path.parent.glob("*.yaml"))
            raise ConfigError(f"unknown task {name!r}", f"use one of {', '.join(known)}, or the path of a task file")
    return read_document(path, ReachTask)
