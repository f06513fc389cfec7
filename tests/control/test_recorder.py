import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from robotctl.control.recorded import read_recording
from robotctl.control.recorder import RecorderConfig, RecorderProcess
from robotctl.control.shared import Board, EventRing, Link
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot

pytestmark = pytest.mark.realtime

ROBOT = load_robot("panda")
SLOTS = 4000


class Writer:
    """Publishes ticks as a loop would."""

    def __init__(self, slots=SLOTS):
        self.link = Link.create(ROBOT.dof, slots)
        self.board_fd = self.link.fds[1]
        self.slots = slots
        self.count = 0
        self.random = np.random.default_rng(0)

    def tick(self, count=1):
        ring = self.link.ticks
        for _ in range(count):
            slot = ring.records[self.count % ring.slots]
            slot["tick"] = self.count
            slot["stamp_ns"] = time.monotonic_ns()
            slot["position"] = self.random.normal(size=ROBOT.dof)
            ring.publish(self.count, 1000)
            self.count += 1

    def event(self, text):
        self.link.events.write({"type": "log", "stamp_ns": time.monotonic_ns(), "text": text})


@pytest.fixture
def writer():
    writer = Writer()
    yield writer
    for fd in writer.link.fds:
        os.close(fd)


@pytest.fixture
def start(tmp_path):
    started = []

    def start(writer, name="run.mcap", **about):
        process = RecorderProcess.start(ROBOT, writer.board_fd, writer.slots, tmp_path / name, about)
        started.append(process)
        return process

    yield start
    for process in started:
        process.stop()


def wait_until(condition, timeout_s=30.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


def wait_for_ticks(path):
    """Until the first tick has reached the disk."""
    wait_until(lambda: path.exists() and "/safety" in read_recording(path, ["/safety"]).topics)


def ticks_in(path):
    return [logged.message["tick"] for logged in read_recording(path, ["/safety"]).topics.get("/safety", [])]


def test_records_all_from_before_its_start_to_its_end(writer, start):
    writer.event("before")
    writer.tick(100)
    recorder = start(writer, backend="sim", seed=3)
    for _ in range(100):
        writer.tick(5)
        time.sleep(0.002)
    assert recorder.running
    writer.tick(300)
    writer.event("after")
    summary = recorder.stop()
    assert summary == {"recorded": 900, "dropped": 0, "path": str(recorder.path)}
    assert not recorder.running
    assert recorder.stop() == summary
    found = read_recording(recorder.path)
    assert found.is_complete
    assert found.metadata["seed"] == "3"
    assert ticks_in(recorder.path) == list(range(900))
    assert [logged.message["message"] for logged in found.topics["/log"]] == ["before", "after"]
    offset = found.topics["/safety"][0].log_time_ns - found.topics["/safety"][0].message["stamp_ns"]
    assert abs(offset - (time.time_ns() - time.monotonic_ns())) < 50_000_000


def test_dropped_ticks_and_events_are_counted(start):
    writer = Writer(slots=200)
    writer.tick(1000)
    for number in range(300):
        writer.event(str(number))
    recorder = start(writer)
    summary = recorder.stop()
    assert (summary["recorded"], summary["dropped"]) == (136, 864)
    dropped = [
        logged.message
        for logged in read_recording(recorder.path).topics["/event"]
        if logged.message["type"] == "dropped"
    ]
    assert [(event["ticks"], event["events"]) for event in dropped] == [(864, 300 - EventRing.SLOTS + 1)]
    assert ticks_in(recorder.path) == list(range(864, 1000))


def test_killed_recorder_leaves_ring_and_file_usable(writer, start):
    recorder = start(writer)
    writer.tick(500)
    wait_for_ticks(recorder.path)
    writer.tick(500)
    before = writer.link.ticks.records.tobytes()
    os.kill(recorder.pid, signal.SIGKILL)
    wait_until(lambda: not recorder.running)
    assert recorder.stop() == {"error": "the recorder was killed by signal 9"}
    assert writer.link.ticks.records.tobytes() == before
    assert writer.link.ticks.head == 1000
    writer.tick(10)
    found = read_recording(recorder.path)
    assert not found.is_complete
    assert ticks_in(recorder.path)[:500] == list(range(500))


def test_board_of_the_recorder_cannot_be_written(writer):
    fd = Board.read_only(writer.board_fd)
    try:
        board = Board.attach(fd, ROBOT.dof, SLOTS)
        writer.tick(3)
        writer.event("hello")
        assert board.ticks.head == 3
        assert board.events.since(0)[0][0]["text"] == "hello"
        with pytest.raises(ValueError, match="read-only"):
            board.ticks.records[0]["tick"] = 1
        with pytest.raises(TypeError):
            board.events.write({"type": "log"})
        with pytest.raises(PermissionError):
            Link.attach(writer.link.fds[0], fd, ROBOT.dof, SLOTS)
    finally:
        os.close(fd)


def test_suspended_recorder_loses_what_was_overwritten_and_says_so(start):
    writer = Writer(slots=500)
    recorder = start(writer)
    writer.tick(100)
    wait_for_ticks(recorder.path)
    os.kill(recorder.pid, signal.SIGSTOP)
    writer.tick(2000)
    summary = recorder.stop()
    assert (summary["recorded"], summary["dropped"]) == (100 + 436, 2000 - 436)
    assert ticks_in(recorder.path) == [*range(100), *range(2100 - 436, 2100)]


def test_full_disk_ends_the_recorder_with_one_line(writer, start):
    recorder = start(writer)
    wait_until(lambda: recorder.path.exists() and recorder.path.stat().st_size > 0)
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (200_000, 200_000))
    deadline = time.monotonic() + 30.0
    while recorder.running and time.monotonic() < deadline:
        writer.tick(20)
        time.sleep(0.01)
    assert not recorder.running
    assert recorder._process.returncode == 1
    summary = recorder.stop()
    assert list(summary) == ["error"]
    assert "File too large" in summary["error"]
    assert str(recorder.path) in summary["error"]
    writer.tick(10)
    assert ticks_in(recorder.path)[:3] == [0, 1, 2]


def run_directly(writer, path, robot="panda"):
    fd = Board.read_only(writer.board_fd)
    config = RecorderConfig(robot, [], fd, writer.slots, str(path), {}, os.getpid())
    try:
        return subprocess.run(
            [sys.executable, "-m", "robotctl.control.recorder", config.to_json()],
            pass_fds=(fd,),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        os.close(fd)


@pytest.mark.parametrize(
    ("robot", "name"), [("panda", "taken.mcap"), ("panda", "no/folder.mcap"), ("nobody", "x.mcap")]
)
def test_error_is_one_line_and_no_traceback(writer, tmp_path, robot, name):
    (tmp_path / "taken.mcap").write_bytes(b"mine")
    done = run_directly(writer, tmp_path / name, robot)
    assert done.returncode == 1
    assert done.stderr == ""
    assert list(json.loads(done.stdout)) == ["error"]
    assert (tmp_path / "taken.mcap").read_bytes() == b"mine"


def test_eof_on_stdin_ends_it(writer, tmp_path):
    writer.tick(10)
    done = run_directly(writer, tmp_path / "run.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["recorded"] == 10


def test_two_runs_never_overwrite_each_other(writer, start):
    recorder = start(writer)
    writer.tick(10)
    recorder.stop()
    before = recorder.path.read_bytes()
    with pytest.raises(ConfigError, match="already exists"):
        start(writer)
    with pytest.raises(ConfigError, match="no folder"):
        start(writer, "missing/run.mcap")
    assert recorder.path.read_bytes() == before


def test_sigterm_finishes_the_file_and_sigint_does_not(writer, start):
    recorder = start(writer)
    writer.tick(50)
    wait_for_ticks(recorder.path)
    assert Path(f"/proc/{recorder.pid}/comm").read_text() == "robotctl-rec\n"
    os.kill(recorder.pid, signal.SIGINT)
    time.sleep(0.3)
    assert recorder.running
    writer.tick(50)
    os.kill(recorder.pid, signal.SIGTERM)
    wait_until(lambda: not recorder.running)
    assert recorder.stop()["recorded"] == 100
    assert read_recording(recorder.path).is_complete


def test_killed_parent_leaves_a_finished_file(tmp_path):
    """The parent is killed together with its memory; the recorder's view of it lives on."""
    path = tmp_path / "run.mcap"
    source = f"""
import os, sys, time
from robotctl.control.recorder import RecorderProcess
from robotctl.control.shared import Link, EventRing
from robotctl.hal.robot import load_robot
robot = load_robot("panda")
link = Link.create(robot.dof, {SLOTS})
for number in range(100):
    link.ticks.records[number]["tick"] = number
    link.ticks.publish(number, 0)
recorder = RecorderProcess.start(robot, link.fds[1], {SLOTS}, {str(path)!r}, {{}})
print(recorder.pid, flush=True)
time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE, text=True)
    recorder = int(parent.stdout.readline())
    wait_for_ticks(path)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_until(lambda: not Path(f"/proc/{recorder}").exists() or "Z" in Path(f"/proc/{recorder}/stat").read_text())
    assert read_recording(path).is_complete
    assert ticks_in(path) == list(range(100))
