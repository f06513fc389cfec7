"""kill -9 and kill -STOP of every process of a run, at random moments."""

import os
import signal
import time
from typing import Any

import pytest

from .conftest import MOMENTS

pytestmark = pytest.mark.realtime
LONG = ("--policy", "random", "--episodes", "4")


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_a_killed_policy_is_braked_and_named(start: Any, backend: str, moment: float) -> None:
    run = start("--backend", backend, *LONG)
    pids = run.wait_running()
    time.sleep(moment)
    os.kill(pids["policy"], signal.SIGKILL)
    status, output, report = run.finish()
    assert status == 3, output
    assert "the policy process was killed by signal 9" in output
    trip = report["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P10", 2)
    assert trip["reaction_ms"] < 100.0
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert report["black_boxes"]
    assert run.left_behind() == []


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_recorder_changes_nothing_but_the_recording(start: Any, moment: float) -> None:
    run = start("--policy", "scripted", "--episodes", "4")
    pids = run.wait_running()
    time.sleep(0.5 * moment)
    os.kill(pids["recorder"], signal.SIGKILL)
    status, output, report = run.finish()
    assert status == 0, output
    assert [episode["success"] for episode in report["episodes"]] == [True] * 4
    assert "the recorder was killed by signal 9" in report["recording_problems"][0]
    assert report["safety"]["trips"] == []
    assert run.left_behind() == []


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_control_process_ends_the_run_as_lost_hardware(start: Any, moment: float) -> None:
    run = start(*LONG)
    pids = run.wait_running()
    time.sleep(moment)
    os.kill(pids["control"], signal.SIGKILL)
    status, output, report = run.finish()
    assert status == 4, output
    assert "the control process was killed by signal 9" in output
    assert report["error"].startswith("the control process was killed by signal 9")
    assert [(trip["protection"], trip["stop_category"]) for trip in report["safety"]["trips"]] == [("P27", 0)]
    assert report["safety"]["state"] == "FAULT"
    assert report["timing"]["ticks"] > 500
    assert report["black_boxes"]
    assert run.left_behind() == []


def test_a_policy_that_comes_back_in_time_goes_on(start: Any, brief: tuple[str, str]) -> None:
    run = start("--policy", "random", "--episodes", "1", *brief)
    pids = run.wait_running()
    os.kill(pids["policy"], signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(pids["policy"], signal.SIGCONT)
    status, output, report = run.finish()
    assert status == 0, output
    assert [trip["protection"] for trip in report["safety"]["trips"]] == ["P10"]
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}


def test_a_policy_that_stays_away_is_latched(start: Any) -> None:
    run = start(*LONG)
    pids = run.wait_running()
    os.kill(pids["policy"], signal.SIGSTOP)
    status, output, report = run.finish()
    assert status == 3, output
    assert report["safety"]["state"] in ("READY", "FAULT")
    assert run.left_behind() == []


def test_an_operator_that_is_killed_takes_the_arm_down_with_it(start: Any) -> None:
    run = start(*LONG)
    run.wait_running()
    run.process.kill()
    run.process.wait()
    deadline = time.monotonic() + 10.0
    while run.left_behind() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert run.left_behind() == []


@pytest.mark.parametrize("robot", ["panda", "openarm"])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 3)])
def test_signals_to_the_operator_stop_the_arm(start: Any, robot: str, number: signal.Signals, status: int) -> None:
    run = start("--robot", robot, *LONG)
    run.wait_running()
    run.process.send_signal(number)
    ended, output, report = run.finish()
    assert ended == status, output
    assert report["safety"]["state"] in ("READY", "FAULT")
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert run.left_behind() == []


def test_sigterm_during_the_start_ends_as_a_stop(start: Any) -> None:
    run = start(*LONG)
    while "control" not in run.pids():
        time.sleep(0.01)
    run.process.send_signal(signal.SIGTERM)
    status, output, _ = run.finish()
    assert status == 3, output
    assert "Traceback" not in output
    assert run.left_behind() == []


def test_sigterm_while_an_interruption_winds_down_ends_as_a_stop(start: Any) -> None:
    run = start("--robot", "openarm", *LONG)
    run.wait_running()
    run.process.send_signal(signal.SIGINT)
    time.sleep(0.3)
    run.process.send_signal(signal.SIGTERM)
    status, output, report = run.finish()
    assert status == 3, output
    assert report["safety"]["state"] == "FAULT"
    assert report["stopped"] == "emergency stop by SIGTERM"
    assert run.left_behind() == []


def test_a_suspended_operator_does_not_leave_the_arm_moving(start: Any) -> None:
    run = start(*LONG)
    run.wait_running()
    os.kill(run.process.pid, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(run.process.pid, signal.SIGCONT)
    status, output, report = run.finish()
    assert status == 3, output
    trip = report["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P30", 2)
    assert trip["reaction_ms"] < 200.0
