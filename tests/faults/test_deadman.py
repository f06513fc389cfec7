"""A deadman's switch in somebody's hand, while a run is going on."""

import os
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import Any

import pytest

from robotctl.control.deadman_device import DeadmanDevice
from robotctl.control.process_session import ProcessSession
from robotctl.hal.robot import Robot
from robotctl.learning.actor import ProcessActor
from robotctl.learning.run import Outcome, run_episodes
from robotctl.learning.task import load_task

pytestmark = pytest.mark.realtime


@pytest.fixture
def switch(tmp_path: Path) -> Iterator[tuple[Path, FileIO]]:
    path = tmp_path / "switch"
    os.mkfifo(path)
    with FileIO(path, "r+") as end:
        yield path, end


def test_letting_go_stops_the_arm_and_holding_on_lets_it_go_on(
    panda: Robot, switch: tuple[Path, FileIO], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    path, end = switch
    task = load_task("reach").model_copy(update={"steps": 60})
    session, outcome, states, asked = ProcessSession(panda, "sim"), Outcome(), [], []

    def squeeze(event: dict[str, Any]) -> None:
        if event["type"] != "state":
            return
        states.append(event["state"])
        if states.count("RUN") == 1 and states[-1] in ("RUN", "HOLD"):
            end.write(b"0\n" if states[-1] == "RUN" else b"1\n")

    session.on_event = squeeze
    session.on_switch = lambda: (asked.append(True), end.write(b"1\n"))
    with DeadmanDevice(path, session.link.desk.hold), session, ProcessActor(session, task, "random", 0) as actor:
        run_episodes(session, actor, task, 1, 0, outcome)
    assert asked
    first = session.trips[0]
    assert (first["protection"], first["stop_category"]) == ("P22", 2)
    assert {trip["protection"] for trip in session.trips[1:]} <= {"P10"}  # a busy machine delays the policy
    begun = states.index("RUN")
    assert states[begun : begun + 4] == ["RUN", "STOPPING", "HOLD", "RUN"]
    assert sum(session.judge.violations.values()) == 0


def test_a_run_says_that_it_waits_for_the_switch(start: Any, switch: tuple[Path, FileIO]) -> None:
    path, end = switch
    run = start("--episodes", "1", "--deadman", str(path))
    run.wait_running()
    end.write(b"1\n")
    status, output, report = run.finish()
    assert status == 0, output
    assert "hold the switch to start" in output
    assert report["safety"]["trips"] == []
    assert run.left_behind() == []


def test_a_switch_that_is_not_there_is_missing_hardware(start: Any, tmp_path: Path) -> None:
    status, output, _ = start("--deadman", str(tmp_path / "js0")).finish()
    assert status == 4, output
    assert "cannot open the deadman's switch" in output
