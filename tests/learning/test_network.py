"""Networks as policies: read whole or not at all, exchanged between episodes, harmless whatever they want."""

import os
from pathlib import Path

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.control.recording_session import SessionRecording
from robotctl.control.session import LockstepSession
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot
from robotctl.learning.actor import InlineActor
from robotctl.learning.network import Network, NetworkPolicy, untrained
from robotctl.learning.policies import make_policy
from robotctl.learning.policy import Observation
from robotctl.learning.run import Outcome, report, run_episodes
from robotctl.learning.task import load_task


def observation(robot: Robot, position: np.ndarray | None = None) -> Observation:
    position = np.array(robot.profile.home) if position is None else position
    return Observation(position, np.zeros(robot.dof), np.array([0.4, 0.0, 0.4]), np.array([0.5, 0.1, 0.3]), 0)


def with_weights(network: Network, **about: object) -> Network:
    return Network(network.weights._replace(**about))


def broken(network: Network) -> Network:
    network.weights.layers[1][0][3, 2] = np.nan
    return network


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "policy.npz"


def test_a_file_holds_all_of_a_network(panda: Robot, path: Path) -> None:
    network = untrained(panda, 3)
    network.save(path)
    again = Network.load(path)
    values = np.linspace(-1.0, 1.0, 17)
    assert np.array_equal(again.act(values), network.act(values))
    assert again.weights[3:] == network.weights[3:]
    assert list(path.parent.iterdir()) == [path]


def test_seeds_make_networks(panda: Robot) -> None:
    values = np.linspace(-1.0, 1.0, 17)
    one, same, other = (untrained(panda, seed).act(values) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_the_action_is_what_the_layers_say(panda: Robot) -> None:
    weights = untrained(panda, 0, hidden=(4,)).weights
    values = np.linspace(0.0, 1.0, 17)
    (first, shift), (second, bias) = weights.layers
    seen = (values - weights.mean) * weights.scale
    assert Network(weights).act(values) == pytest.approx(np.tanh(np.tanh(seen @ first + shift) @ second + bias))


def test_velocities_use_the_caps_and_no_more(robot: Robot, path: Path) -> None:
    untrained(robot, 0).save(path)
    policy = make_policy(str(path), robot, Kinematics(robot))
    rng = np.random.default_rng(0)
    poses = rng.uniform(robot.limits.lower, robot.limits.upper, (200, robot.dof))
    shares = np.array([np.abs(policy.act(observation(robot, pose))) / robot.limits.velocity for pose in poses])
    assert shares.max() <= 1.0
    assert shares.max() > 0.9


@pytest.mark.parametrize("size", [0, 1, 100, 2000, -1])
def test_a_file_that_is_not_whole_is_refused(panda: Robot, path: Path, size: int) -> None:
    untrained(panda, 0, hidden=(4,)).save(path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ConfigError, match=r"policy.npz: cannot be read as a network"):
        NetworkPolicy(panda, path)


def test_a_flipped_byte_in_the_weights_is_refused(panda: Robot, path: Path) -> None:
    untrained(panda, 0).save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ConfigError, match="cannot be read as a network"):
        NetworkPolicy(panda, path)


def test_what_is_no_file_of_weights_is_refused(panda: Robot, path: Path) -> None:
    with pytest.raises(ConfigError, match="FileNotFound"):
        NetworkPolicy(panda, path)
    np.savez(path, W0=np.zeros((17, 7)))
    with pytest.raises(ConfigError, match="cannot be read as a network"):
        NetworkPolicy(panda, path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ConfigError, match="cannot be read as a network"):
        NetworkPolicy(panda, path)
    np.savez(path, spec=np.array([object()]), allow_pickle=True)  # nothing in a file is ever run
    with pytest.raises(ConfigError, match="cannot be read as a network"):
        NetworkPolicy(panda, path)


def test_foreign_stale_and_broken_weights_are_refused(panda: Robot, path: Path) -> None:
    network = untrained(panda, 0)
    for bad, text in (
        (untrained(load_robot("kinova"), 0), "15 observations and 6 actions instead of 17 observations and 7 actions"),
        (untrained(load_robot("xarm7"), 0), "another robot than this panda"),
        (untrained(load_robot("panda", ["sphere.radius=0.3"]), 0), "other limits"),
        (with_weights(network, made_ns=0), "s old"),
        (with_weights(network, version=0), "version 0"),
        (broken(untrained(panda, 0)), "not finite"),
    ):
        bad.save(path)
        with pytest.raises(ConfigError, match=text):
            NetworkPolicy(panda, path)


def test_a_file_that_changed_is_taken_before_the_next_episode(panda: Robot, path: Path) -> None:
    one, two = untrained(panda, 1), untrained(panda, 2)
    seen = observation(panda)
    one.save(path)
    policy = NetworkPolicy(panda, path)
    first = policy.act(seen)
    two.save(path)
    assert np.array_equal(policy.act(seen), first)
    assert policy.begin() == ""
    assert not np.array_equal(policy.act(seen), first)


def test_bad_weights_are_refused_once_and_the_old_ones_stay(panda: Robot, path: Path) -> None:
    one, seen = untrained(panda, 1), observation(panda)
    one.save(path)
    policy = NetworkPolicy(panda, path)
    first = policy.act(seen)
    broken(untrained(panda, 2)).save(path)
    assert policy.begin() == f"{path}: a value is not finite"
    assert policy.begin() == ""
    with_weights(untrained(panda, 3), made_ns=one.weights.made_ns - 1).save(path)
    assert policy.begin() == f"{path}: older than those in use"
    path.write_text("half a fi")
    assert "cannot be read as a network" in policy.begin()
    path.unlink()
    assert "FileNotFound" in policy.begin()
    assert policy.begin() == ""
    assert np.array_equal(policy.act(seen), first)
    untrained(panda, 3).save(path)
    assert policy.begin() == ""
    assert not np.array_equal(policy.act(seen), first)


def test_a_file_that_is_only_touched_is_read_again_and_changes_nothing(panda: Robot, path: Path) -> None:
    untrained(panda, 1).save(path)
    policy = NetworkPolicy(panda, path)
    first = policy.act(observation(panda))
    os.utime(path, ns=(1, 1))
    assert policy.begin() == ""
    assert np.array_equal(policy.act(observation(panda)), first)


@pytest.mark.parametrize(("name", "backend"), [("panda", "sim"), ("openarm", "sim"), ("panda", "can")])
def test_an_untrained_network_violates_nothing_in_ten_seconds(name: str, backend: str, path: Path) -> None:
    robot = load_robot(name)
    untrained(robot, 5).save(path)
    task = load_task("reach").model_copy(update={"steps": 200})
    with LockstepSession(robot, backend) as session:
        outcome = Outcome()
        run_episodes(session, InlineActor(session, task, str(path), 0), task, 1, 0, outcome)
        assert outcome.stopped == ""
        assert outcome.episodes[0].steps == 200
        assert sum(session.judge.violations.values()) == 0
        assert session.judge.on_truth
        assert session.statistics.clipped > 500  # else it asked for nothing that mattered


def test_an_episode_whose_weights_are_refused_does_not_take_place(panda: Robot, path: Path) -> None:
    untrained(panda, 1).save(path)
    task = load_task("reach").model_copy(update={"steps": 20})

    def spoil(index: int, _: object) -> None:
        if index == 0:
            broken(untrained(panda, 2)).save(path)
        elif index == 2:
            untrained(panda, 3).save(path)

    with LockstepSession(panda, "sim") as session:
        outcome = Outcome()
        run_episodes(session, InlineActor(session, task, str(path), 0), task, 4, 0, outcome, spoil)
        made = report(session, outcome, {}, SessionRecording(Path("nowhere.mcap")))
    assert outcome.stopped == ""
    assert [episode.steps for episode in outcome.episodes] == [20, 0, 20, 20]
    assert [bool(episode.refused) for episode in outcome.episodes] == [False, True, False, False]
    assert made["safety"]["refused"] == [{"protection": "P26", "cause": f"{path}: a value is not finite"}]
    assert made["safety"]["trips"] == []
    assert made["safety"]["state"] == "READY"
