"""Counts violations of the invariants, on the plant's true state where there is one, else on what was measured."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.robot import Robot
from robotctl.safety.machine import ENABLED
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip

POSITION_BOUND = 0.5e-3
"""rad past a soft limit"""
REGION_BOUND = 2e-3
"""m outside the sphere, or inside a keep-out region"""


class Judge:
    """Takes tick records in any portions.

    Not judged are ticks with the drives off, when nobody commands the arm, and those of an arm that began outside
    its limits and has not finished its retreat.
    """

    def __init__(self, robot: Robot) -> None:
        self._limits = robot.limits
        self._centre = np.array(robot.profile.sphere.centre)
        self._radius = robot.profile.sphere.radius
        self._enabled = np.array(sorted(ENABLED))
        self._keep_outs = regions(robot.profile)[1:]
        self._bounds = {
            "position": POSITION_BOUND,
            "velocity": robot.profile.safety.velocity_tolerance,
            "sphere": REGION_BOUND,
        }
        if self._keep_outs:
            self._bounds["keep_out"] = REGION_BOUND
        self.violations = dict.fromkeys(self._bounds, 0)
        """Ticks beyond each bound; "keep_out" counts where the profile has any."""
        self.worst = dict.fromkeys(self._bounds, -np.inf)
        """Largest excess over each limit seen, rad, rad/s and m; negative while inside."""
        self.judged = 0
        self.on_truth = True

    def take(self, records: NDArray[Any]) -> None:
        """Judge some tick records (`control.shared.tick_dtype`)."""
        records = records[np.isin(records["state"], self._enabled) & (records["clip"] & Clip.RECOVERY == 0)]
        if not len(records):
            return
        truth = bool(records["has_truth"].all())
        self.on_truth &= truth
        prefix = "true_" if truth else ""
        position, velocity, tool = (records[prefix + key] for key in ("position", "velocity", "tool"))
        excess = {
            "position": np.maximum(position - self._limits.upper, self._limits.lower - position).max(axis=1),
            "velocity": (np.abs(velocity) - self._limits.velocity).max(axis=1),
            "sphere": np.linalg.norm(tool - self._centre, axis=1) - self._radius,
        }
        if self._keep_outs:
            rooms = [[region.room(point) for region in self._keep_outs] for point in tool]
            excess["keep_out"] = -np.min(rooms, axis=1)
        for key, values in excess.items():
            self.violations[key] += int((values > self._bounds[key]).sum())
            self.worst[key] = max(self.worst[key], float(values.max()))
        self.judged += len(records)
