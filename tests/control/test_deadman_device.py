"""The deadman's switch: lines and joystick events, through a FIFO and a pseudo-terminal, and what waits for it."""

import os
import pty
import struct
import threading
import time
from collections.abc import Callable, Iterator
from io import FileIO
from pathlib import Path

import pytest

from robotctl.control.deadman_device import DeadmanDevice
from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.errors import HardwareError
from robotctl.hal.robot import Robot
from robotctl.safety.deadman import Grip
from robotctl.safety.machine import State

PATIENCE_S = 10.0


class Told(list[Grip]):
    """What a device has told so far."""

    def awaits(self, *grips: Grip) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while self != list(grips):
            assert time.monotonic() < deadline, self
            time.sleep(0.002)


def event(value: int, kind: int = 1, number: int = 0) -> bytes:
    return struct.pack("=IhBB", 12345, value, kind, number)


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[[str], tuple[Told, FileIO]]]:
    """Open a FIFO of a name as a switch; return what it tells, and the end to write to."""
    devices: list[DeadmanDevice] = []
    ends: list[FileIO] = []

    def open_it(name: str) -> tuple[Told, FileIO]:
        path, told = tmp_path / name, Told()
        os.mkfifo(path)
        devices.append(DeadmanDevice(path, told.append).__enter__())
        ends.append(FileIO(path, "w"))
        return told, ends[-1]

    yield open_it
    for device in devices:
        device.__exit__(None, None, None)
    for end in ends:
        end.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "deadman"]


def test_lines_tell_how_it_is_held(opened) -> None:
    told, end = opened("switch")
    told.awaits(Grip.RELEASED)
    end.write(b"1\n")
    told.awaits(Grip.RELEASED, Grip.HELD)
    end.write(b"2\n0\r\n")
    told.awaits(Grip.RELEASED, Grip.HELD, Grip.SQUEEZED, Grip.RELEASED)


def test_a_line_may_come_in_pieces_and_what_makes_no_sense_lets_go(opened) -> None:
    told, end = opened("switch")
    end.write(b"1")
    time.sleep(0.05)
    assert told == [Grip.RELEASED]
    end.write(b"\n11\n1\n\n")
    told.awaits(Grip.RELEASED, Grip.HELD, Grip.RELEASED, Grip.HELD, Grip.RELEASED)


def test_the_first_button_of_a_joystick_is_the_switch(opened) -> None:
    told, end = opened("js0")
    # How things stand when it is opened; another button; an axis.
    end.write(event(0, 0x81) + event(1, number=1) + event(1, kind=2))
    told.awaits(Grip.RELEASED, Grip.RELEASED)
    end.write(event(1)[:5])
    time.sleep(0.05)
    end.write(event(1)[5:] + event(0))
    told.awaits(Grip.RELEASED, Grip.RELEASED, Grip.HELD, Grip.RELEASED)


@pytest.mark.parametrize("name", ["switch", "js0"])
def test_one_that_ends_is_unplugged(opened, name: str) -> None:
    told, end = opened(name)
    end.write(b"1\n" if name == "switch" else event(1))
    told.awaits(Grip.RELEASED, Grip.HELD)
    end.close()
    told.awaits(Grip.RELEASED, Grip.HELD, Grip.UNPLUGGED)


def test_a_serial_port_is_read_and_its_loss_noticed() -> None:
    told = Told()
    controller, port = pty.openpty()
    name = Path(os.ttyname(port))
    os.close(port)
    with DeadmanDevice(name, told.append):
        os.write(controller, b"1\n")
        told.awaits(Grip.RELEASED, Grip.HELD)
        os.close(controller)
        told.awaits(Grip.RELEASED, Grip.HELD, Grip.UNPLUGGED)


def test_a_switch_that_is_not_there_says_so(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match=r"cannot open the deadman's switch .*js9: No such file"):
        DeadmanDevice(tmp_path / "js9", lambda grip: None).__enter__()


# -- what waits for it ---------------------------------------------------------------------------------------------


@pytest.fixture
def session(panda: Robot) -> Iterator[LockstepSession]:
    with LockstepSession(panda, "sim") as made:
        made.request(Verb.ARM)
        yield made


def test_without_a_switch_nothing_waits(session: LockstepSession) -> None:
    session.on_switch = lambda: pytest.fail("waited")
    session.reset()
    session.begin()
    assert session.state is State.RUN


@pytest.mark.parametrize("what", ["begin", "reset"])
def test_nothing_begins_before_the_switch_is_held(session: LockstepSession, what: str) -> None:
    asked: list[int] = []
    session.link.desk.hold(Grip.RELEASED)
    session.on_switch = lambda: asked.append(session.clock.now_ns())

    def press() -> None:
        if asked and session.clock.now_ns() > asked[0] + 1_000_000_000:
            session.link.desk.hold(Grip.HELD)

    session.on_poll = press
    getattr(session, what)()
    assert session.state is (State.RUN if what == "begin" else State.ARMED)
    assert len(asked) == 1
    assert session.clock.now_ns() - asked[0] >= 1_000_000_000
    assert session.trips == []


def test_a_switch_that_is_unplugged_is_not_waited_for(session: LockstepSession) -> None:
    session.link.desk.hold(Grip.UNPLUGGED)
    with pytest.raises(Stopped, match="unplugged"):
        session.reset()
    assert session.state is State.ARMED
