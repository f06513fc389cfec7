"""P28: a disk that is full and a recorder that stands still cost the recording, and the arm nothing."""

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from robotctl.control.recorded import read_recording

pytestmark = pytest.mark.realtime


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 kB: little more than a second of a recording."""
    folder = tmp_path / "small"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", folder], check=False).returncode:
        pytest.skip("no file system may be mounted here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_full_disk_costs_the_recording_and_nothing_else(start: Any, small_disk: Path) -> None:
    run = start("--episodes", "3", "--record", str(small_disk / "run.mcap"))
    status, output, report = run.finish()
    assert status == 0, output
    assert [episode["success"] for episode in report["episodes"]] == [True] * 3
    (problem,) = report["recording_problems"]
    assert "No space left on device" in problem
    assert problem in output
    assert report["safety"]["trips"] == []
    assert report["timing"]["dropped"] == 0
    assert run.left_behind() == []


def test_a_full_disk_does_not_keep_a_stop_from_ending_well(start: Any, small_disk: Path) -> None:
    run = start("--policy", "nan", "--record", str(small_disk / "run.mcap"))
    (small_disk / "ballast").write_bytes(bytes(250_000))
    status, output, report = run.finish()
    assert status == 3, output
    assert [trip["protection"] for trip in report["safety"]["trips"]] == ["P9"]
    assert report["safety"]["state"] == "FAULT"
    assert report["black_boxes"] == []
    assert any("no black box of the trip" in problem for problem in report["recording_problems"])


def test_a_suspended_recorder_catches_up_at_the_end(start: Any) -> None:
    run = start("--episodes", "3")
    os.kill(run.wait_running()["recorder"], signal.SIGSTOP)
    status, output, report = run.finish()
    assert status == 0, output
    assert report["recording_problems"] == []
    recording = read_recording(report["recording"], ["/safety"])
    assert recording.is_complete
    messages = [logged.message for logged in recording.topics["/safety"]]
    assert [message["tick"] for message in messages] == list(range(len(messages)))
    assert messages[-1]["state"] == "READY"  # the arm was parked and off
