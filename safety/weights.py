"""P26: which weights a policy may act with. What is refused leaves those in use where they are."""

from typing import NamedTuple

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.asked import Refusal
from robotctl.safety.trip import Protection

_AHEAD_NS = 60_000_000_000
"""By how much the clock of whoever made them may be ahead."""


class Weights(NamedTuple):
    """A fully connected network, and what it says of itself."""

    layers: tuple[tuple[Vector, Vector], ...]
    """Matrix (inputs, outputs) and bias (outputs,) of each layer, from the observation to the action."""
    mean: Vector
    """Taken from the observation (m,) ..."""
    scale: Vector
    """... before it is multiplied with this (m,)."""
    version: int
    """Of what observations and actions mean."""
    observations: int
    actions: int
    limits_hash: str
    """`Robot.limits_hash` of the arm they were made for."""
    made_ns: int
    """Wall clock, ns since 1970."""


class WeightsGate:
    """Judges the weights that one policy is offered."""

    def __init__(self, robot: Robot, version: int, observations: int, max_age_s: float) -> None:
        self.in_use: Weights | None = None
        """The latest that were accepted."""
        self._version = version
        self._sizes = (observations, robot.dof)
        self._limits_hash = robot.limits_hash
        self._name = robot.profile.name
        self._max_age_s = max_age_s

    def offer(self, weights: Weights, now_ns: int) -> Refusal | None:
        """Take weights into use, or return why not; then the episode has to end.

        Args:
            now_ns: wall clock, ns since 1970.
        """
        complaint = self._misfit(weights) or self._staleness(weights, now_ns) or _damage(weights)
        if complaint:
            return Refusal(Protection.WEIGHTS, complaint)
        self.in_use = weights
        return None

    def _misfit(self, weights: Weights) -> str:
        if weights.version != self._version:
            return f"version {weights.version} instead of {self._version}"
        if (weights.observations, weights.actions) != self._sizes:
            expected = "{} observations and {} actions".format(*self._sizes)
            return f"{weights.observations} observations and {weights.actions} actions instead of {expected}"
        if weights.limits_hash != self._limits_hash:
            return f"made for another robot than this {self._name}, or for other limits"
        return ""

    def _staleness(self, weights: Weights, now_ns: int) -> str:
        if weights.made_ns > now_ns + _AHEAD_NS:
            return f"made {(weights.made_ns - now_ns) / 1e9:.0f} s in the future; check the clocks"
        if now_ns - weights.made_ns > self._max_age_s * 1e9:
            return f"{(now_ns - weights.made_ns) / 1e9:.0f} s old, at most {self._max_age_s:.0f} s are allowed"
        if self.in_use is not None and weights.made_ns < self.in_use.made_ns:
            return "older than those in use"
        return ""


def _damage(weights: Weights) -> str:
    inputs = weights.observations
    for index, (matrix, bias) in enumerate(weights.layers):
        if bias.ndim != 1 or matrix.shape != (inputs, len(bias)):
            return f"layer {index} has shapes {matrix.shape} and {bias.shape} behind {inputs} values"
        inputs = len(bias)
    if inputs != weights.actions:
        return f"the last layer gives {inputs} values instead of {weights.actions}"
    for name in ("mean", "scale"):
        shape = getattr(weights, name).shape
        if shape != (weights.observations,):
            return f"the {name} has shape {shape} instead of ({weights.observations},)"
    arrays = [weights.mean, weights.scale, *(array for layer in weights.layers for array in layer)]
    return "" if all(np.isfinite(array).all() for array in arrays) else "a value is not finite"
