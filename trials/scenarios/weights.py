"""P26: weights that a policy must not act with."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.learning.network import Network, NetworkPolicy, untrained
from robotctl.learning.policy import Observation
from robotctl.trials.scenario import Scenario, Trial

_AGED_NS = 2 * 365 * 86400 * 10**9

Spoil = Callable[[Robot, Path], None]


def _replaced(change: Callable[[Robot, Network], Network]) -> Spoil:
    """Return what writes a network that was changed."""
    return lambda robot, path: change(robot, untrained(robot, 1)).save(path)


def _truncated(_robot: Robot, path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _with_nan(_robot: Robot, network: Network) -> Network:
    (matrix, bias), *others = network.weights.layers
    spoilt = matrix.copy()
    spoilt[0, 0] = np.nan
    return Network(network.weights._replace(layers=((spoilt, bias), *others)))


def _with(**fields: Any) -> Callable[[Robot, Network], Network]:
    return lambda _robot, network: Network(network.weights._replace(**fields))


def _aged(_robot: Robot, network: Network) -> Network:
    return Network(network.weights._replace(made_ns=time.time_ns() - _AGED_NS))


def _fewer_actions(robot: Robot, network: Network) -> Network:
    *layers, (matrix, bias) = network.weights.layers
    weights = network.weights._replace(layers=(*layers, (matrix[:, :-1], bias[:-1])), actions=robot.dof - 1)
    return Network(weights)


def _refused(name: str, provoked: str, spoil: Spoil) -> Scenario:
    """Return the scenario of weights that are exchanged for bad ones, and then for good ones."""

    def run(robot: Robot, _backend: str, _seed: int) -> Trial:
        trial = Trial()
        observation = Observation(
            np.array(robot.profile.home), np.zeros(robot.dof), np.array([0.3, 0.0, 0.3]), np.array([0.4, 0.0, 0.4]), 0
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "policy.npz"
            untrained(robot, 0).save(path)
            policy = NetworkPolicy(robot, path)
            before = policy.act(observation)
            spoil(robot, path)
            trial.require(bool(policy.begin()), "the bad weights were taken into use")
            trial.require(bool((policy.act(observation) == before).all()), "the good weights did not stay in use")
            untrained(robot, 2).save(path)
            trial.require(not policy.begin(), "good weights were refused afterwards")
            trial.require(not bool((policy.act(observation) == before).all()), "good weights were not taken into use")
        trial.seen = "refused, the old ones stay; cleared by valid ones"
        return trial

    return Scenario(26, name, provoked, "refused; cleared by valid weights", run, 1)


def scenarios(_robot: Robot, _backend: str) -> list[Scenario]:
    return [
        _refused("damaged", "a file that ends half-way", _truncated),
        _refused("NaN", "a weight that is no number", _replaced(_with_nan)),
        _refused("another robot", "weights of another robot", _replaced(_with(limits_hash="0" * 16))),
        _refused("another version", "observations that mean something else", _replaced(_with(version=0))),
        _refused("too old", "weights of two years ago", _replaced(_aged)),
        _refused("wrong shape", "one action too few", _replaced(_fewer_actions)),
    ]
