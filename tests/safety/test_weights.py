"""Weights are taken into use only whole, fresh, and made for this very arm."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Protection
from robotctl.safety.weights import Weights, WeightsGate

NOW = 1_800_000_000_000_000_000
SECOND = 1_000_000_000
OBSERVATIONS, HIDDEN, ACTIONS = 17, 5, 7


def weights(robot: Robot, **about) -> Weights:
    layers = ((np.ones((OBSERVATIONS, HIDDEN)), np.ones(HIDDEN)), (np.ones((HIDDEN, ACTIONS)), np.ones(ACTIONS)))
    mean, scale = np.zeros(OBSERVATIONS), np.ones(OBSERVATIONS)
    made = Weights(layers, mean, scale, 3, OBSERVATIONS, ACTIONS, robot.limits_hash, NOW - 10 * SECOND)
    return made._replace(**about)


@pytest.fixture
def gate(panda: Robot) -> WeightsGate:
    return WeightsGate(panda, 3, OBSERVATIONS, max_age_s=60.0)


def refused(gate: WeightsGate, offered: Weights, now: int = NOW) -> str:
    """Offer weights after good ones; return why they are refused, having seen that the good ones stay in use."""
    before = gate.in_use
    refusal = gate.offer(offered, now)
    assert refusal is not None
    assert refusal.protection is Protection.WEIGHTS
    assert gate.in_use is before
    return refusal.text


def test_good_weights_are_taken_into_use(panda: Robot, gate: WeightsGate) -> None:
    assert gate.in_use is None
    one, two = weights(panda), weights(panda, made_ns=NOW)
    assert gate.offer(one, NOW) is None
    assert gate.in_use is one
    assert gate.offer(two, NOW) is None
    assert gate.in_use is two


def test_a_refusal_lasts_until_good_weights_come(panda: Robot, gate: WeightsGate) -> None:
    assert gate.offer(weights(panda), NOW) is None
    refused(gate, weights(panda, version=4))
    assert gate.offer(weights(panda), NOW) is None


@pytest.mark.parametrize(
    ("about", "text"),
    [
        ({"version": 2}, "version 2 instead of 3"),
        ({"version": 4}, "version 4 instead of 3"),
        ({"observations": 18}, "18 observations and 7 actions instead of 17 observations and 7 actions"),
        ({"actions": 6}, "17 observations and 6 actions instead of 17 observations and 7 actions"),
        ({"limits_hash": "0" * 64}, "made for another robot than this panda, or for other limits"),
        ({"layers": ()}, "the last layer gives 17 values instead of 7"),
        ({"mean": np.zeros(16)}, "the mean has shape (16,) instead of (17,)"),
        ({"scale": np.ones((17, 1))}, "the scale has shape (17, 1) instead of (17,)"),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_what_does_not_fit_is_refused(panda: Robot, gate: WeightsGate, about, text: str, first: bool) -> None:
    if not first:
        assert gate.offer(weights(panda), NOW) is None
    assert refused(gate, weights(panda, **about)) == text


@pytest.mark.parametrize(
    ("layer", "shapes"),
    [
        (0, ((OBSERVATIONS + 1, HIDDEN), (HIDDEN,))),
        (0, ((OBSERVATIONS, HIDDEN), (HIDDEN + 1,))),
        (0, ((OBSERVATIONS, HIDDEN), (HIDDEN, 1))),
        (0, ((OBSERVATIONS,), (HIDDEN,))),
        (1, ((HIDDEN + 1, ACTIONS), (ACTIONS,))),
        (1, ((HIDDEN, ACTIONS, 1), (ACTIONS,))),
    ],
)
def test_layers_that_do_not_fit_together_are_refused(panda: Robot, gate: WeightsGate, layer: int, shapes) -> None:
    layers = list(weights(panda).layers)
    layers[layer] = tuple(np.ones(shape) for shape in shapes)
    text = refused(gate, weights(panda, layers=tuple(layers)))
    assert text.startswith(f"layer {layer} has shapes {shapes[0]} and {shapes[1]}")
    assert text.endswith(f"behind {(OBSERVATIONS, HIDDEN)[layer]} values")


def test_a_last_layer_of_another_size_is_refused(panda: Robot, gate: WeightsGate) -> None:
    layers = (weights(panda).layers[0], (np.ones((HIDDEN, ACTIONS + 1)), np.ones(ACTIONS + 1)))
    assert refused(gate, weights(panda, layers=layers)) == "the last layer gives 8 values instead of 7"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["mean", "scale", (0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_value_that_is_no_number_is_refused_wherever_it_stands(panda: Robot, gate: WeightsGate, bad, where) -> None:
    offered = weights(panda)
    array = getattr(offered, where) if isinstance(where, str) else offered.layers[where[0]][where[1]]
    array.flat[-1] = bad
    assert refused(gate, offered) == "a value is not finite"


@pytest.mark.parametrize(
    ("age_ns", "good"),
    [(60 * SECOND, True), (60 * SECOND + 1, False), (-60 * SECOND, True), (-60 * SECOND - 1, False)],
)
def test_weights_have_an_age(panda: Robot, gate: WeightsGate, age_ns: int, good: bool) -> None:
    offered = weights(panda, made_ns=NOW - age_ns)
    if good:
        assert gate.offer(offered, NOW) is None
    else:
        assert refused(gate, offered) in (
            "60 s old, at most 60 s are allowed",
            "made 60 s in the future; check the clocks",
        )


def test_older_weights_than_those_in_use_are_refused(panda: Robot, gate: WeightsGate) -> None:
    assert gate.offer(weights(panda, made_ns=NOW - SECOND), NOW) is None
    assert refused(gate, weights(panda, made_ns=NOW - SECOND - 1)) == "older than those in use"
    assert gate.offer(weights(panda, made_ns=NOW - SECOND), NOW) is None


def test_weights_in_use_do_not_grow_old(panda: Robot, gate: WeightsGate) -> None:
    assert gate.offer(weights(panda), NOW) is None
    assert "at most 60 s" in refused(gate, weights(panda), NOW + 100 * SECOND)
    assert gate.in_use is not None
