"""Another process, alive, stopped, ending and gone."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from robotctl.control.other_process import OtherProcess

SLEEP = "import time; print(flush=True); time.sleep(60)"


@pytest.fixture
def child() -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-c", SLEEP], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process
        process.kill()


@pytest.fixture
def other(child: subprocess.Popen[bytes]) -> Iterator[OtherProcess]:
    pidfd = os.pidfd_open(child.pid)
    yield OtherProcess(child.pid, pidfd)
    os.close(pidfd)


def test_one_that_lives_is_not_over(other: OtherProcess, child: subprocess.Popen[bytes]) -> None:
    assert not other.is_over(1)
    child.send_signal(signal.SIGSTOP)
    assert not other.is_over(20)


@pytest.mark.parametrize("stopped", [False, True])
def test_killed_it_is_over_whatever_it_did(other: OtherProcess, child: subprocess.Popen[bytes], stopped: bool) -> None:
    if stopped:
        child.send_signal(signal.SIGSTOP)
    other.kill()
    assert other.is_over(5000)
    child.send_signal(signal.SIGCONT)
    assert child.wait(5) == -signal.SIGKILL
    assert other.is_over(0)
    other.kill()
    assert other.is_over(0)


def test_a_zombie_is_over(other: OtherProcess, child: subprocess.Popen[bytes]) -> None:
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert other.is_over(0)


def test_one_that_ended_before_anybody_looked_is_over(child: subprocess.Popen[bytes]) -> None:
    pidfd = os.pidfd_open(child.pid)
    child.kill()
    child.wait()
    assert OtherProcess(child.pid, pidfd).is_over(0)
    os.close(pidfd)


def test_one_that_the_kernel_still_takes_apart_is_over() -> None:
    """Half a gigabyte of pages takes the kernel tens of milliseconds; nobody should wait for that."""
    code = f"import mmap, time; m = mmap.mmap(-1, {1 << 29}); m[::4096] = bytes({1 << 17}); " + SLEEP
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        pidfd = os.pidfd_open(process.pid)
        other = OtherProcess(process.pid, pidfd)
        process.kill()
        deadline = time.monotonic() + 5.0
        while not other.is_over(0):
            assert time.monotonic() < deadline
        early = not other._ended.poll(0)
        process.wait()
        os.close(pidfd)
    assert early
