"""P27: real drives behind a bus, and a control process that dies or stands still. Judged on what the drives heard."""

import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from .conftest import JOINTS, MOMENTS, Emulator, Run

pytestmark = pytest.mark.realtime

DRIVE_WATCHDOG_S = 0.1
RUN = ("--backend", "can", "--policy", "random", "--episodes", "4")


@pytest.fixture
def emulator(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Emulator]:
    robot = getattr(request, "param", "openarm")
    emulator = Emulator(tmp_path, "--register", f"all:TIMEOUT={DRIVE_WATCHDOG_S / 50e-6:.0f}", robot=robot)
    yield emulator
    emulator.end()


def strike(run: Run, pid: int, number: signal.Signals) -> tuple[int, str, dict[str, Any]]:
    """Send a signal to a process of a run; wake it up a second later if it only sleeps; return how the run ends."""
    os.kill(pid, number)
    if number == signal.SIGSTOP:
        time.sleep(1.0)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    return run.finish()


def taken_over(emulator: Emulator) -> float:
    """Assert that the drives were taken in time and for good; return when, on the drives' clock."""
    emulator.end()
    frames = emulator.heard()
    last = max(frame.at_s for frame in frames if frame.kind == "track")
    after = [frame for frame in frames if frame.at_s > last]
    first = {motor: min(frame.at_s for frame in after if frame.motor == motor) for motor in range(1, JOINTS + 1)}
    print(f"taken over {1e3 * (max(first.values()) - last):.1f} ms after the last frame")
    assert max(first.values()) - last < DRIVE_WATCHDOG_S
    assert {frame.kind for frame in after} == {"damp", "DISABLE"}
    assert "COMMUNICATION_LOST" not in emulator.text
    assert len(set(re.findall(r"(\S+): ENABLED -> DISABLED", emulator.text))) == JOINTS + 1
    return max(first.values())


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "stop"])
def test_an_arm_without_brakes_is_lowered(
    start: Any, emulator: Emulator, number: signal.Signals, moment: float
) -> None:
    run = start("--robot", "openarm", "--channel", emulator.channel, *RUN)
    pids = run.wait_running()
    time.sleep(moment)
    status, output, report = strike(run, pids["control"], number)
    assert status == 4, output
    (trip,) = report["safety"]["trips"]
    assert (trip["protection"], trip["stop_category"]) == ("P27", 0)
    assert f"robotctl: P27: {trip['cause']}" in output
    assert "damped, lowered and switched off" in report["error"]
    assert report["safety"]["state"] == "FAULT"
    assert report["black_boxes"]
    assert run.left_behind() == []
    began = taken_over(emulator)
    assert emulator.heard()[-1].at_s - began > 2.0
    # While it falls freely, a joint passes 5 rad/s.
    assert abs(emulator.speeds(began + 0.3)).max() < 2.5


@pytest.mark.parametrize("emulator", ["panda"], indirect=True)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "stop"])
def test_an_arm_with_brakes_is_switched_off(start: Any, emulator: Emulator, number: signal.Signals) -> None:
    run = start("--robot", "panda", "--channel", emulator.channel, *RUN)
    status, output, report = strike(run, run.wait_running()["control"], number)
    assert status == 4, output
    assert [trip["protection"] for trip in report["safety"]["trips"]] == ["P27"]
    assert run.left_behind() == []
    began = taken_over(emulator)
    assert emulator.heard()[-1].at_s - began < 0.5


def test_the_watchman_outlives_operator_and_control(start: Any, emulator: Emulator) -> None:
    run = start("--robot", "openarm", "--channel", emulator.channel, *RUN)
    pids = run.wait_running()
    for pid in (run.process.pid, pids["control"]):
        os.kill(pid, signal.SIGKILL)
    run.process.wait()
    deadline = time.monotonic() + 15.0
    while run.left_behind() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert run.left_behind() == []
    taken_over(emulator)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "stop"])
def test_an_arm_whose_watchman_is_gone_stops(start: Any, number: signal.Signals) -> None:
    run = start("--policy", "random", "--episodes", "4")
    os.kill(run.wait_running()["watchman"], number)
    status, output, report = run.finish()
    assert status == 3, output
    assert [(trip["protection"], trip["stop_category"]) for trip in report["safety"]["trips"]] == [("P27", 2)]
    assert report["safety"]["violations"] == {"position": 0, "velocity": 0, "sphere": 0}
    assert run.left_behind() == []


def test_a_run_that_ends_well_ends_its_watchman(start: Any, emulator: Emulator) -> None:
    run = start("--robot", "openarm", "--channel", emulator.channel, "--backend", "can", "--episodes", "1")
    pids = run.wait_running()
    status, output, report = run.finish()
    assert status == 0, output
    assert report["safety"]["trips"] == []
    assert report["processes"]["watchman"] == pids["watchman"]
    assert "P27" not in output
    assert run.left_behind() == []
