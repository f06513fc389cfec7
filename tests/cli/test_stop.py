"""`robotctl stop` as a person types it."""

import os
import signal

import pytest
from typer.testing import CliRunner

from robotctl.cli.main import app
from robotctl.control import registry
from robotctl.control.registry import Running


def test_one_that_has_just_ended_does_not_keep_the_others_from_being_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = {101, 103}
    signalled = []

    def kill(pid: int, number: int) -> None:
        if pid not in alive:
            raise ProcessLookupError
        alive.remove(pid)
        signalled.append((pid, number))

    entries = [Running(pid, 7, 1, "panda", "sim", "") for pid in (101, 102, 103)]
    monkeypatch.setattr(registry, "running", lambda: entries)
    monkeypatch.setattr(registry, "start_time", lambda pid: 7 if pid in alive else None)
    monkeypatch.setattr(os, "kill", kill)
    result = CliRunner().invoke(app, ["stop"])
    assert signalled == [(101, signal.SIGUSR1), (103, signal.SIGUSR1)]
    assert result.exit_code == 0, result.output
    assert result.output.count("stopped panda") == 3
