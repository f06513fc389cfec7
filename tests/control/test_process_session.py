"""A session in a process of its own, around a control process that is busy when it is asked to end, or fails."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from robotctl.control import registry
from robotctl.control.frame_replay import replay_states
from robotctl.control.operator import Verb
from robotctl.control.process_session import ProcessSession
from robotctl.control.shared import Board
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.robot import Robot, load_robot, profile_path
from robotctl.safety.machine import State

pytestmark = pytest.mark.realtime

SLOW_S = 1.0
"""How long the drives of the backend `slow` take to come on."""

BACKEND = f"""
import time

from robotctl.sim.backend import open_sim


def open_slow(robot, clock, channel=""):
    rig = open_sim(robot, clock)
    enable = rig.arm.enable

    def slow():
        time.sleep({SLOW_S})
        enable()

    rig.arm.enable = slow
    return rig
"""


FRAIL = """
from pathlib import Path

from robotctl.sim.backend import open_sim

HERE = Path(__file__).parent


def open_frail(robot, clock, channel=""):
    rig = open_sim(robot, clock)
    read = rig.arm.read

    def frail():
        if (HERE / "now").exists():
            raise ZeroDivisionError("a bug")
        return read()

    def take_over(command):
        (HERE / "taken").write_text(command.mode.name)

    rig.arm.read = frail
    rig.arm.take_over = take_over
    return rig
"""


def install(folder: Path, name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let child processes find a backend."""
    (folder / f"{name}.py").write_text(source)
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[robotctl.backends]\n{name} = {name}:open_{name}\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(folder))


@pytest.fixture
def session(panda: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ProcessSession]:
    install(tmp_path, "slow", BACKEND, monkeypatch)
    session = ProcessSession(panda, "slow")
    session.open()
    session.link.desk.ask(Verb.ARM)  # and whoever asked was interrupted
    time.sleep(0.3 * SLOW_S)
    assert session.state is State.READY  # for all that can be seen
    yield session
    session.close()


def test_closing_while_the_drives_come_on_switches_them_off(session: ProcessSession) -> None:
    began = time.monotonic()
    session.close()
    assert session._process is not None
    assert session._process.returncode == 0
    assert time.monotonic() - began < 4.0
    assert [trip["protection"] for trip in session.trips] == ["P23"]


@pytest.mark.parametrize("how", ["wind_down", "bring_to_rest"])
def test_at_rest_means_that_nothing_comes_on_any_more(session: ProcessSession, how: str) -> None:
    if how == "wind_down":
        session.wind_down()
    else:
        session.bring_to_rest(Verb.DISARM)
    assert session.state is State.READY
    states = [event["text"] for event in session.link.events.since(0)[0] if event["type"] == "state"]
    assert states[-1].endswith("-> READY")
    assert len(states) > 3
    time.sleep(SLOW_S)
    assert session.state is State.READY


def test_a_channel_belongs_to_one_process_at_a_time(panda: Robot, tmp_path: Path) -> None:
    port, alias = tmp_path / "ttyACM0", tmp_path / "arm"
    port.touch()
    alias.symlink_to(port)
    with registry.claim(f"slcan:{port}"):
        session = ProcessSession(panda, "can", f"slcan:{alias}", ["servo_hz=250"])
        with pytest.raises(HardwareError, match="in use by another robotctl"), session:
            pass
        registry.claim("slcan:/dev/ttyACM1").close()
    registry.claim(f"slcan:{port}").close()


def test_a_bug_in_the_loop_hands_the_drives_to_the_watchman(
    panda: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "frail", FRAIL, monkeypatch)
    with ProcessSession(panda, "frail", "slcan:nowhere") as session:
        session.request(Verb.ARM)
        (tmp_path / "now").touch()
        with pytest.raises(HardwareError, match="ZeroDivisionError: a bug") as told:
            session.advance(5.0)
        assert "its drives are switched off" in str(told.value)
        assert (tmp_path / "taken").read_text() == "DAMP"
        assert [(trip["protection"], trip["stop_category"]) for trip in session.trips] == [("P27", 0)]
        assert session.state is State.FAULT


def test_a_bug_with_the_drives_off_leaves_nothing_to_take(
    panda: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "frail", FRAIL, monkeypatch)
    with ProcessSession(panda, "frail", "slcan:nowhere") as session:
        (tmp_path / "now").touch()
        with pytest.raises(HardwareError, match="a bug"):
            session.advance(5.0)
        assert session.trips == []
        assert not (tmp_path / "taken").exists()


def test_neither_a_reader_that_stands_still_nor_memory_that_is_closed_holds_the_loop_up(
    panda: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    with ProcessSession(panda, "sim") as session:
        fd, slots = Board.read_only(session.fds[1]), session.link.ticks.slots
        source = f"from robotctl.control.shared import Board; board = Board.attach({fd}, 7, {slots}); print(flush=True)"
        command = [sys.executable, "-c", source + "\nwhile True: board.ticks.since(0)"]
        with subprocess.Popen(command, pass_fds=[fd], stdout=subprocess.PIPE) as viewer:
            assert viewer.stdout is not None
            viewer.stdout.readline()
            viewer.send_signal(signal.SIGSTOP)
            for mine in (fd, *session.fds):
                os.close(mine)
            session.link.fds = None
            session.request(Verb.ARM)
            before = session.link.ticks.head
            session.advance(1.0)
            assert session.link.ticks.head - before > 400
            assert session.state is State.ARMED
            viewer.kill()


def test_limits_that_changed_since_they_were_seen_are_refused_line_by_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "panda.yaml"
    path.write_text(profile_path("panda").read_text())
    session = ProcessSession(load_robot(str(path)), "sim")
    path.write_text(path.read_text().replace("radius: 0.42", "radius: 0.52"))
    with pytest.raises(ConfigError, match=r"panda.yaml: limits changed while it was being started") as caught, session:
        pass
    assert "\n- sphere.radius: 0.42\n+ sphere.radius: 0.52\n" in str(caught.value)
    assert session._process is not None
    assert session._process.returncode == 2


def test_what_limits_nothing_may_be_edited_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "panda.yaml"
    path.write_text(profile_path("panda").read_text())
    session = ProcessSession(load_robot(str(path)), "sim")
    path.write_text(path.read_text().replace("title: Franka", "title: My"))
    with session:
        assert session.state is State.READY


def test_the_frames_of_the_bus_reach_this_side_as_they_were_decoded():
    robot = load_robot("openarm")
    with ProcessSession(robot, "can", "emulated") as session:
        session.advance(0.3)
        frames = session.frames
    ticks = {int(tick["stamp_ns"]): tick for tick in session.link.ticks.since(0)[0]}
    states = list(replay_states(frames.snapshot(), frames.description))
    assert len(states) == len(ticks) > 50
    for state in states:
        assert state.position.tobytes() == ticks[state.stamp_ns]["position"].tobytes()
        assert state.effort.tobytes() == ticks[state.stamp_ns]["effort"].tobytes()


def test_without_a_bus_no_memory_is_taken_for_frames():
    with ProcessSession(load_robot("openarm"), "sim") as session:
        assert session.frames is None
