"""The kernel's queue, as far as it shows without a CAN interface; the rest is in tests/interop/kernel."""

import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from robotctl.hal.can.kernel_queue import KernelQueue
from robotctl.hal.errors import BusError


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.fixture
def queue(pair) -> KernelQueue:
    return KernelQueue("can9", SimpleNamespace(socket=pair[0]))


def instead_of_ip(folder: Path, monkeypatch, script: str) -> Path:
    program, log = folder / "ip", folder / "log"
    program.write_text(f"#!/bin/sh\necho $* >>{log}\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr("robotctl.hal.can.kernel_queue.shutil.which", lambda *_, **__: str(program))
    return log


def test_what_nobody_has_taken_yet_waits(queue, pair):
    ours, theirs = pair
    assert not queue.waiting()
    ours.send(b"frame")
    assert queue.waiting()
    theirs.recv(16)
    assert not queue.waiting()


def test_a_purge_takes_the_interface_down_and_up(queue, tmp_path, monkeypatch):
    log = instead_of_ip(tmp_path, monkeypatch, "exit 0")
    queue.purge()
    assert log.read_text().splitlines() == ["link set can9 down", "link set can9 up"]


@pytest.mark.parametrize(
    ("script", "said"), [("echo not permitted >&2; exit 2", "not permitted"), ("exit 1", "does not say why")]
)
def test_a_purge_that_is_not_permitted_says_what_to_do(queue, tmp_path, monkeypatch, script, said):
    instead_of_ip(tmp_path, monkeypatch, script)
    with pytest.raises(BusError, match=said) as caught:
        queue.purge()
    assert "leave the power of the drives off" in str(caught.value)
    assert "ip link set can9 down; ip link set can9 up" in str(caught.value)


def test_a_host_without_ip_says_what_to_do(queue, tmp_path, monkeypatch):
    monkeypatch.setattr("robotctl.hal.can.kernel_queue.shutil.which", lambda *_, **__: str(tmp_path / "none"))
    with pytest.raises(BusError, match="could not be set down"):
        queue.purge()


def test_an_interface_that_cannot_be_listened_to_is_named(queue):
    with pytest.raises(BusError, match="cannot listen on can9"):
        queue.witness()
