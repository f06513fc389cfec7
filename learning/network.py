"""A network as a policy: fully connected, tanh, in numpy; one `.npz` file with its weights and what they are for.

Arrays of the file: `W0`, `b0`, `W1`, `b1`, ... from the observation to the action, `mean` and `scale` of the
observation, and `spec`, a JSON text. An action of 1 is a joint's velocity cap.
"""

import json
import time
import zipfile
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np

from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.learning.policy import Observation, Policy
from robotctl.safety.weights import Weights, WeightsGate

VERSION = 1
"""Of the observation: joints, rad; their velocities, rad/s; from the tool to the goal, m."""
_MAX_AGE_S = 365 * 86400.0
_SPEC: dict[str, Any] = {"version": int, "observations": int, "actions": int, "limits_hash": str, "made_ns": int}
_DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What numpy raises for files that are not, or no longer, what they should be."""


@dataclass(frozen=True, slots=True)
class Network:
    """A network from observations (2n + 3,) to actions (n,)."""

    weights: Weights

    def act(self, values: Vector) -> Vector:
        """Return the action (n,), each value in -1..1, for observed values (2n + 3,)."""
        values = (values - self.weights.mean) * self.weights.scale
        for matrix, bias in self.weights.layers:
            values = np.tanh(values @ matrix + bias)
        return values

    def save(self, path: Path) -> None:
        """Write it to a file, which appears as a whole or not at all."""
        weights = self.weights
        arrays: dict[str, Any] = {"mean": weights.mean, "scale": weights.scale}
        for index, (matrix, bias) in enumerate(weights.layers):
            arrays |= {f"W{index}": matrix, f"b{index}": bias}
        arrays["spec"] = np.array(json.dumps({key: getattr(weights, key) for key in _SPEC}))
        temporary = path.with_name(f".{path.name}.part")
        with temporary.open("wb") as file:
            np.savez(file, **arrays)
        temporary.replace(path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read it from a file, unjudged.

        Raises:
            ConfigError: if the file is missing, or is not one of a network.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                spec = json.loads(str(file["spec"]))
                count = sum(name.startswith("W") for name in file.files)
                layers = tuple((_numbers(file[f"W{index}"]), _numbers(file[f"b{index}"])) for index in range(count))
                about = {key: kind(spec[key]) for key, kind in _SPEC.items()}
                return cls(Weights(layers, _numbers(file["mean"]), _numbers(file["scale"]), **about))
        except _DAMAGED as error:
            raise ConfigError(f"{path}: cannot be read as a network: {error!r}", "export it again") from None


def untrained(robot: Robot, seed: int, hidden: tuple[int, ...] = (100, 100)) -> Network:
    """Return a network with random weights. Observations are scaled to the robot's limits; actions tend to be large."""
    rng = np.random.default_rng(seed)
    limits, n = robot.limits, robot.dof
    mean = np.concatenate([0.5 * (limits.lower + limits.upper), np.zeros(n + 3)])
    scale = np.concatenate([2.0 / (limits.upper - limits.lower), 1.0 / limits.velocity, np.full(3, 10.0)])
    layers = tuple(
        (rng.normal(0.0, 1.5 / np.sqrt(inputs), (inputs, outputs)), rng.normal(0.0, 0.5, outputs))
        for inputs, outputs in pairwise([len(mean), *hidden, n])
    )
    return Network(Weights(layers, mean, scale, VERSION, len(mean), n, robot.limits_hash, time.time_ns()))


class NetworkPolicy(Policy):
    """A network whose file is looked at before every episode: what came anew is used if it passes the gate (P26)."""

    def __init__(self, robot: Robot, path: Path) -> None:
        """Load the file.

        Raises:
            ConfigError: if it is damaged or refused.
        """
        self._path = path
        self._cap = robot.limits.velocity
        self._gate = WeightsGate(robot, VERSION, 2 * robot.dof + 3, _MAX_AGE_S)
        self._seen = self._signature()
        refusal = self._take()
        if refusal:
            raise ConfigError(refusal, "export it for this robot, with the limits it has now")

    def begin(self) -> str:
        signature = self._signature()
        if signature == self._seen:
            return ""
        self._seen = signature
        try:
            return self._take()
        except ConfigError as error:
            return error.what

    def act(self, observation: Observation) -> Vector:
        position, velocity, tool, goal, _ = observation
        return self._cap * self._network.act(np.concatenate([position, velocity, goal - tool]))

    def _take(self) -> str:
        network = Network.load(self._path)
        refusal = self._gate.offer(network.weights, time.time_ns())
        if refusal is not None:
            return f"{self._path}: {refusal.text}"
        self._network = network
        return ""

    def _signature(self) -> tuple[int, ...]:
        """Return what changes when somebody writes the file; nothing if it is gone."""
        try:
            status = self._path.stat()
        except OSError:
            return ()
        return status.st_mtime_ns, status.st_size, status.st_ino


def _numbers(array: object) -> Vector:
    return np.asarray(array, dtype=np.float64)
