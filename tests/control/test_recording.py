import json
import math
import subprocess
import sys
import time

import numpy as np
import pytest

import robotctl
from robotctl.control.recorded import read_recording
from robotctl.control.recording import Recording, wall_offset_ns
from robotctl.control.shared import tick_dtype
from robotctl.hal.clock import VirtualClock
from robotctl.hal.robot import load_robot
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip

OFFSET_NS = 1_700_000_000_000_000_000
ROBOT = load_robot("panda")
JOINTS = [joint.name for joint in ROBOT.profile.joints]


def make_records(count, first=0, truth=True):
    """Records in which every number of every joint differs."""
    records = np.zeros(count, tick_dtype(ROBOT.dof))
    random = np.random.default_rng(first)
    for name in records.dtype.names:
        if records.dtype[name].base == np.float64:
            records[name] = random.normal(size=records[name].shape)
    records["tick"] = np.arange(first, first + count)
    records["stamp_ns"] = 5_000_000_000 + 2_000_000 * records["tick"]
    records["lateness_ns"] = 1500 + records["tick"]
    records["duration_ns"] = 300_000 + records["tick"]
    records["epoch"] = 3
    records["seq"] = 11
    records["state"] = State.RUN
    records["has_truth"] = truth
    return records


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


def record(path, records, events=(), about=None):
    with Recording.open(path, ROBOT, about or {}, OFFSET_NS) as recording:
        recording.take(records, events)
    return read_recording(path)


def test_values_survive_the_round_trip(path):
    records = make_records(50)
    found = record(path, records)
    assert found.is_complete
    for topic, columns in {
        "/state/joints": ("position", "velocity", "effort"),
        "/command/joints": ("command_position", "command_velocity", "command_effort"),
        "/truth/joints": ("true_position", "true_velocity", None),
    }.items():
        messages = found.topics[topic]
        assert [logged.log_time_ns for logged in messages] == (records["stamp_ns"] + OFFSET_NS).tolist()
        for key, column in zip(("position", "velocity", "effort"), columns, strict=True):
            values = [logged.message[key] for logged in messages]
            assert values == ([[None] * ROBOT.dof] * 50 if column is None else records[column].tolist())
        assert all(logged.message["name"] == JOINTS for logged in messages)
    for topic, column in {"/state/tool": "tool", "/truth/tool": "true_tool"}.items():
        messages = [logged.message for logged in found.topics[topic]]
        assert [message["point"] for message in messages] == records[column].tolist()
        assert {message["frame_id"] for message in messages} == {"base"}
    assert [logged.message["values"] for logged in found.topics["/wanted"]] == records["wanted"].tolist()


def test_safety_channel_names_state_and_clips(path):
    records = make_records(3)
    records["clip"] = [0, Clip.VELOCITY | Clip.SPHERE, Clip.RECOVERY]
    records["state"] = [State.RUN, State.STOPPING, 77]
    messages = [logged.message for logged in record(path, records).topics["/safety"]]
    assert [message["clip"] for message in messages] == [[], ["VELOCITY", "SPHERE"], ["RECOVERY"]]
    assert [message["state"] for message in messages] == ["RUN", "STOPPING", "UNKNOWN(77)"]
    assert messages[1] == {
        "tick": 1,
        "stamp_ns": 5_002_000_000,
        "state": "STOPPING",
        "epoch": 3,
        "seq": 11,
        "clip": ["VELOCITY", "SPHERE"],
        "lateness_us": 1.501,
        "duration_us": 300.001,
    }


def test_no_truth_channel_without_truth(path):
    found = record(path, make_records(3, truth=False))
    assert "/truth/joints" not in found.topics
    assert "/truth/tool" not in found.topics


def test_zeros_are_values(path):
    records = make_records(1)
    records["position"] = records["tool"] = 0.0
    found = record(path, records)
    assert found.topics["/state/joints"][0].message["position"] == [0.0] * ROBOT.dof
    assert found.topics["/state/tool"][0].message["point"] == [0.0] * 3


def test_numbers_that_are_none_can_be_recorded(path):
    records = make_records(1)
    records["wanted"] = [math.nan, math.inf, *[0.5] * (ROBOT.dof - 2)]
    records["position"] = math.nan
    found = record(path, records)
    assert found.topics["/wanted"][0].message["values"] == [None, None, *[0.5] * (ROBOT.dof - 2)]
    assert all(math.isnan(value) for value in found.topics["/state/joints"][0].message["position"])


def test_events_are_kept_whole_and_texts_logged(path):
    events = [
        {"type": "trip", "stamp_ns": 1, "protection": "heartbeat", "stop_category": 2, "text": "no target"},
        {"type": "answer", "stamp_ns": 2, "number": 4, "ok": False, "text": "refused"},
        {"type": "answer", "stamp_ns": 3, "number": 5, "ok": True, "text": ""},
        {"type": "bus", "stamp_ns": 4, "statistics": {"sent": 7}},
        {"type": "log", "stamp_ns": 5, "text": "real time: SCHED_FIFO"},
    ]
    found = record(path, make_records(0), events)
    assert [logged.message for logged in found.topics["/event"]] == events
    assert [logged.log_time_ns for logged in found.topics["/event"]] == [OFFSET_NS + n for n in range(1, 6)]
    assert [logged.message for logged in found.topics["/log"]] == [
        {"level": 4, "name": "trip", "message": "no target"},
        {"level": 3, "name": "answer", "message": "refused"},
        {"level": 2, "name": "log", "message": "real time: SCHED_FIFO"},
    ]


def test_file_says_what_it_is_about(path):
    found = record(path, make_records(1), about={"backend": "sim", "seed": 7})
    assert found.metadata["robot"] == "panda"
    assert found.metadata["backend"] == "sim"
    assert found.metadata["seed"] == "7"
    assert found.metadata["version"] == robotctl.__version__
    assert found.wall_offset_ns == OFFSET_NS
    assert found.attachments["profile.yaml"] == ROBOT.source.read_bytes()
    assert json.loads(found.attachments["profile.json"]) == json.loads(ROBOT.profile.model_dump_json())


def test_other_readers_find_schemas_and_order(path):
    reader = pytest.importorskip("mcap.reader")
    record(path, make_records(20), [{"type": "log", "stamp_ns": 5_000_000_001, "text": "x"}])
    with path.open("rb") as file:
        opened = reader.make_reader(file, validate_crcs=True)
        summary = opened.get_summary()
        schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
        times = [message.log_time for _, _, message in opened.iter_messages()]
    assert times == sorted(times)
    assert schemas["/state/joints"].name == "foxglove.JointStates"
    assert schemas["/log"].name == "foxglove.Log"
    assert schemas["/safety"].encoding == "jsonschema"
    assert json.loads(schemas["/safety"].data)["type"] == "object"


def test_wall_clock_is_now():
    assert abs(time.monotonic_ns() + wall_offset_ns() - time.time_ns()) < 50_000_000
    clock = VirtualClock(5)
    assert abs(clock.now_ns() + wall_offset_ns(clock) - time.time_ns()) < 50_000_000


def test_recordings_are_never_overwritten(path):
    record(path, make_records(5))
    before = path.read_bytes()
    with pytest.raises(FileExistsError):
        Recording.open(path, ROBOT, {})
    assert path.read_bytes() == before


def test_topics_can_be_chosen(path):
    record(path, make_records(5))
    assert list(read_recording(path, ["/safety"]).topics) == ["/safety"]


def test_unfinished_file_is_readable_up_to_its_end(path, tmp_path):
    with Recording.open(path, ROBOT, {"seed": 1}, OFFSET_NS) as recording:
        for part in range(4):
            recording.take(make_records(100, 100 * part))
            recording.flush()
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = []
    for length in range(0, len(data), len(data) // 60):
        cut.write_bytes(data[:length])
        found = read_recording(cut)
        assert not found.is_complete
        ticks = [logged.message["tick"] for logged in found.topics.get("/safety", [])]
        assert ticks == list(range(len(ticks)))
        counts.append(len(ticks))
    assert counts == sorted(counts)
    assert set(counts) == {0, 100, 200, 300, 400}


def test_other_files_are_refused(path):
    path.write_bytes(b"no MCAP file at all")
    with pytest.raises(ValueError, match="not an MCAP file"):
        read_recording(path)


def test_full_disk_is_an_error_and_nothing_else(path):
    """In a process of its own, for the limit holds for all its files."""
    source = f"""
import errno, resource
from robotctl.control.recording import Recording
from robotctl.control.shared import tick_dtype
from robotctl.hal.robot import load_robot
import numpy as np
robot = load_robot("panda")
records = np.zeros(2000, tick_dtype(robot.dof))
records["position"] = np.random.default_rng(0).normal(size=(2000, robot.dof))
recording = Recording.open({str(path)!r}, robot, {{}})
recording.take(records[:100])
recording.flush()
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
failed = 0
for _ in range(10):
    try:
        recording.take(records)
    except OSError as error:
        assert error.errno == errno.EFBIG, error
        failed += 1
assert failed
for finish in (recording.flush, recording.close):
    try:
        finish()
    except OSError as error:
        assert error.errno == errno.EFBIG, error
    else:
        raise AssertionError(finish)
recording.close()
"""
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert path.stat().st_size == 100_000
    found = read_recording(path)
    assert not found.is_complete
    assert len(found.topics["/safety"]) >= 100


def test_two_recordings_at_once_do_not_mix(tmp_path):
    with (
        Recording.open(tmp_path / "a.mcap", ROBOT, {}, OFFSET_NS) as first,
        Recording.open(tmp_path / "b.mcap", ROBOT, {}, OFFSET_NS) as second,
    ):
        first.take(make_records(5))
        second.take(make_records(7))
    assert len(read_recording(tmp_path / "a.mcap").topics["/safety"]) == 5
    assert len(read_recording(tmp_path / "b.mcap").topics["/safety"]) == 7


def test_keeps_up_with_five_times_real_time(path):
    """Measured: 24 to 39 times. CPU time, since other tests may share the core."""
    records = make_records(2000)
    with Recording.open(path, ROBOT, {}) as recording:
        begin = time.process_time()
        for first in range(0, len(records), 25):
            recording.take(records[first : first + 25])
        recording.flush()
        elapsed = time.process_time() - begin
    assert elapsed < len(records) / ROBOT.profile.servo_hz / 5
