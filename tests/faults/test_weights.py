"""Weights that are exchanged under a running policy process (P26)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotctl.hal.robot import load_robot
from robotctl.learning.network import untrained

from .conftest import PATIENT

pytestmark = pytest.mark.realtime


def test_bad_weights_cost_an_episode_and_the_run_goes_on_with_the_old_ones(
    start: Any, brief: tuple[str, str], tmp_path: Path
) -> None:
    robot, path = load_robot("panda", PATIENT), tmp_path / "policy.npz"
    untrained(robot, 0).save(path)
    run = start("--policy", str(path), "--episodes", "3", *brief)
    run.wait_running()
    bad = untrained(robot, 1)
    bad.weights.layers[0][1][0] = np.inf
    bad.save(path)
    status, output, report = run.finish()
    assert status == 0, output
    assert "refused  P26" in output
    assert [episode["steps"] for episode in report["episodes"]] == [60, 0, 60]
    assert [entry["protection"] for entry in report["safety"]["refused"]] == ["P26"]
    assert report["safety"]["trips"] == []
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert run.left_behind() == []


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", None])
def test_a_network_that_cannot_be_used_ends_the_run_before_it_starts(
    start: Any, tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "policy.npz"
    if content is None:
        untrained(load_robot("xarm7"), 0).save(path)
    else:
        path.write_bytes(content)
    status, output, report = start("--policy", str(path)).finish()
    assert status == 2, output
    assert str(path) in output
    assert report == {}
