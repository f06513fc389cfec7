"""P11 and P12 in real time: a loop that was suspended, a machine that is overloaded, motors that fall silent."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robotctl.control.recorded import read_recording

from .conftest import Emulator

pytestmark = pytest.mark.realtime

UNHARMED = {"position": 0, "velocity": 0, "sphere": 0}
SPIN = """
import os, time
end = time.monotonic() + {seconds}
while time.monotonic() < end and os.getppid() == {parent}:
    pass
"""


@contextmanager
def burners(seconds: float) -> Iterator[None]:
    """Keep all cores busy, for at most so long."""
    code = SPIN.format(seconds=seconds, parent=os.getpid())
    with ExitStack() as stack:
        for _ in range(len(os.sched_getaffinity(0))):
            stack.callback(stack.enter_context(subprocess.Popen([sys.executable, "-c", code])).kill)
        yield


def speeds_after_the_fault(path: str) -> NDArray[np.float64]:
    """Return the true joint speeds of a recording from 50 ms after its last change of state on, rad/s.

    A run may end sooner than that: the drives are off, and nobody waits. Then its last speeds are what counts.
    """
    recording = read_recording(path, ["/event", "/truth/joints"])
    change = [event for event in recording.topics["/event"] if event.message["type"] == "state"][-1]
    assert change.message["state"] == "FAULT"
    truth = recording.topics["/truth/joints"]
    since = min(change.log_time_ns + 50_000_000, truth[-1].log_time_ns)
    return np.array([log.message["velocity"] for log in truth if log.log_time_ns >= since])


@pytest.mark.parametrize("backend", ["sim", "can"])
def test_a_suspended_loop_stops_the_arm_and_does_not_move_it_again(start: Any, backend: str) -> None:
    # Not a hostile policy: while nobody drives them, the drives follow their last command past any limit.
    run = start("--backend", backend, "--policy", "scripted", "--episodes", "9")
    control = run.wait_running()["control"]
    os.kill(control, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(control, signal.SIGCONT)
    status, output, report = run.finish()
    assert status == 3, output
    trip = report["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P11", 1)
    assert "the loop stood still for" in trip["cause"]
    assert "P27" not in {trip["protection"] for trip in report["safety"]["trips"]}
    assert "P27: the loop has stood still" in output  # the watchman says so; the drives live in the same process
    assert report["safety"]["state"] == "FAULT"
    assert report["safety"]["violations"] == UNHARMED
    assert abs(speeds_after_the_fault(report["recording"])).max() < 0.01
    assert run.left_behind() == []


def test_an_overloaded_machine_harms_nothing(start: Any) -> None:
    run = start("--policy", "random", "--episodes", "2")
    run.wait_running()
    with burners(8.0):
        status, output, report = run.finish()
    assert status in (0, 3), output
    # A policy that does not get to run is stopped for, and so is a loop that does not.
    assert {trip["protection"] for trip in report["safety"]["trips"]} <= {"P10", "P11"}
    assert report["timing"]["ticks"] > 1000
    assert run.left_behind() == []
    messages = [log.message for log in read_recording(report["recording"], ["/safety"]).topics["/safety"]]
    late = sum(message["lateness_us"] > 2000.0 for message in messages)
    assert late <= report["timing"]["overruns"]
    if report["timing"]["lateness_us"]["max"] > 8_000.0:
        pytest.skip("the machine itself stood still for longer than a load of processes can account for")
    assert report["safety"]["violations"] == UNHARMED


def test_motors_that_fall_silent_stop_the_arm(start: Any, tmp_path: Path) -> None:
    emulator = Emulator(tmp_path)
    try:
        run = start(
            "--backend",
            "can",
            "--robot",
            "openarm",
            "--channel",
            emulator.channel,
            "--policy",
            "random",
            "--episodes",
            "4",
        )
        run.wait_running()
        emulator.process.send_signal(signal.SIGSTOP)
        time.sleep(0.12)
        emulator.process.send_signal(signal.SIGCONT)
        status, output, report = run.finish()
    finally:
        emulator.end()
    assert status == 3, output
    trip = report["safety"]["trips"][0]
    assert (trip["protection"], trip["stop_category"]) == ("P12", 1)
    assert trip["reaction_ms"] < 50.0
    assert report["safety"]["state"] == "FAULT"
    assert report["safety"]["violations"] == UNHARMED
    assert run.left_behind() == []
