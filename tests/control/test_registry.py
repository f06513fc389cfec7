"""Who is found by `robotctl stop`."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from robotctl.control import registry


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    """Another process, in a registry of its own."""
    monkeypatch.setenv("ROBOTCTL_RUNTIME_DIR", str(tmp_path))
    with subprocess.Popen(["sleep", "60"]) as process:
        yield process
        process.kill()


def test_a_watchman_counts_once_its_control_process_is_gone(other: subprocess.Popen[bytes]) -> None:
    path = registry.register("openarm", "can", "socketcan:can0", 1, watches=other.pid)
    assert registry.running() == []
    assert path.exists()
    other.kill()
    other.wait()
    (entry,) = registry.running()
    assert (entry.pid, entry.robot, entry.channel) == (os.getpid(), "openarm", "socketcan:can0")


def test_a_control_process_counts_as_long_as_it_lives(other: subprocess.Popen[bytes]) -> None:
    path = registry.register("panda", "sim", "", 1)
    assert [entry.watches for entry in registry.running()] == [0]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"started": 1}))
    assert registry.running() == []
    assert not path.exists()
