import resource
import threading
import time

import numpy as np
import pytest

from robotctl.control.black_box import BlackBox, snapshot
from robotctl.control.recorded import read_recording
from robotctl.control.shared import Link
from robotctl.hal.robot import load_robot

ROBOT = load_robot("panda")
SLOTS = 3000
SECOND = 1_000_000_000


class Rig:
    """A ring and somebody who writes to it."""

    def __init__(self, tmp_path, slots=SLOTS):
        self.link = Link.local(ROBOT.dof, slots)
        self.stem = tmp_path / "run"
        self.box = BlackBox(ROBOT, self.link, self.stem, {"seed": 5}, 0)
        self.count = 0

    def tick(self, count):
        ring = self.link.ticks
        for _ in range(count):
            slot = ring.records[self.count % ring.slots]
            slot["tick"] = self.count
            slot["stamp_ns"] = self.count * ROBOT.period_ns
            ring.publish(self.count, 0)
            self.count += 1

    def trip(self, text="no target"):
        event = {"type": "trip", "stamp_ns": self.count * ROBOT.period_ns, "protection": "heartbeat", "text": text}
        self.link.events.write(event)
        self.box.on_trip(event)

    def ticks(self, number):
        found = read_recording(f"{self.stem}-trip-{number}.mcap")
        return [logged.message["tick"] for logged in found.topics["/safety"]]


@pytest.fixture
def rig(tmp_path):
    rig = Rig(tmp_path)
    yield rig
    rig.box.flush()


def join(box):
    """Wait for the files without hurrying them."""
    for thread in list(box._writing):
        thread.join(timeout=60.0)
        assert not thread.is_alive()


def test_holds_what_the_ring_remembers_and_the_stop(rig):
    rig.tick(4000)
    rig.trip()
    rig.tick(100)
    time.sleep(0.1)
    assert rig.box.paths == []  # a second of the ring's own time has not passed yet
    rig.tick(500)
    join(rig.box)
    assert [path.name for path in rig.box.paths] == ["run-trip-1.mcap"]
    assert rig.ticks(1) == list(range(4600 - SLOTS + 64, 4600))
    found = read_recording(rig.box.paths[0])
    assert found.is_complete
    assert found.metadata["trip"] == "no target"
    assert found.metadata["seed"] == "5"
    assert [logged.message["text"] for logged in found.topics["/event"]] == ["no target"]


def test_flush_does_not_wait_for_a_loop_that_has_ended(rig):
    rig.tick(100)
    rig.trip()
    begin = time.monotonic()
    (path,) = rig.box.flush()
    assert time.monotonic() - begin < 1.0
    assert path.exists()
    assert rig.ticks(1) == list(range(100))


def test_waits_only_so_long_for_the_stop(rig):
    rig.tick(100)
    rig.trip()
    join(rig.box)
    assert rig.ticks(1) == list(range(100))


def test_flush_without_a_trip_writes_nothing(rig, tmp_path):
    rig.tick(10)
    assert rig.box.flush() == []
    assert list(tmp_path.iterdir()) == []


def test_trip_before_the_first_tick(rig):
    rig.trip()
    (path,) = rig.box.flush()
    assert list(read_recording(path).topics) == ["/event", "/log"]


def test_trips_of_one_stop_share_a_file_and_later_ones_do_not(rig):
    rig.tick(10)
    rig.trip("first")
    rig.trip("second")
    rig.box.flush()
    rig.tick(600)
    rig.trip("third")
    rig.box.flush()
    assert [path.name for path in rig.box.paths] == ["run-trip-1.mcap", "run-trip-2.mcap"]
    assert [read_recording(path).metadata["trip"] for path in rig.box.paths] == ["first", "third"]


def test_files_of_an_earlier_run_stay(tmp_path):
    (tmp_path / "run-trip-1.mcap").write_bytes(b"mine")
    rig = Rig(tmp_path)
    rig.trip()
    assert [path.name for path in rig.box.flush()] == ["run-trip-2.mcap"]
    assert (tmp_path / "run-trip-1.mcap").read_bytes() == b"mine"


def test_failure_is_told_and_nothing_else(tmp_path):
    rig = Rig(tmp_path / "missing")
    rig.tick(10)
    rig.trip("that one")
    assert rig.box.flush() == []
    (problem,) = rig.box.problems
    assert "that one" in problem
    assert "No such file or directory" in problem


def test_full_disk_is_told(rig):
    rig.tick(2000)
    rig.link.ticks.records["position"] = np.random.default_rng(0).normal(size=(SLOTS, ROBOT.dof))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        rig.trip()
        rig.box.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert rig.box.paths == []
    assert "File too large" in rig.box.problems[0]


def test_does_not_hold_up_the_operator(tmp_path):
    """A full ring of 60 s at 500 Hz; nothing here may take longer than an operator can wait."""
    rig = Rig(tmp_path, slots=30_000)
    rig.tick(30_000)
    begin = time.monotonic()
    rig.trip()
    assert time.monotonic() - begin < 0.1
    rig.tick(500)
    longest, last = 0.0, time.monotonic()
    while any(thread.is_alive() for thread in rig.box._writing):
        time.sleep(0.01)
        longest, last = max(longest, time.monotonic() - last), time.monotonic()
    assert longest < 0.8
    assert len(rig.ticks(1)) == 30_000 - 64


def test_snapshot_is_consecutive_beside_a_fast_writer(rig):
    rig.tick(SLOTS)
    ending = threading.Event()

    def write():
        while not ending.is_set():
            rig.tick(10)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for _ in range(50):
            ticks = snapshot(rig.link.ticks)["tick"]
            assert (np.diff(ticks) == 1).all()
    finally:
        ending.set()
        thread.join()
