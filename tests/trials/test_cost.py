"""What safety costs is measured where it is called."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot
from robotctl.trials.cost import Stopwatch, bench_safety


@pytest.mark.parametrize("mode", ["velocity", "torque"])
def test_every_call_of_shaper_and_guard_is_timed(panda: Robot, mode: str) -> None:
    report = bench_safety(panda, "can", mode, "random", 1000)
    for layer in ("shaper", "guard"):
        assert 950 < report[layer]["calls"] < 2000  # and the braking in the end
        assert 0.0 < report[layer]["p50"] <= report[layer]["p99"]


def test_a_stopwatch_tells_long_calls_from_short_ones() -> None:
    short, long = Stopwatch(), Stopwatch()
    for _ in range(400):
        assert short.around(lambda x: x)(3) == 3
        long.around(np.arange)(20_000)
    assert short.report()["p50"] < long.report()["p50"]
