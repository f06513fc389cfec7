"""The control process: how it ends."""

from types import SimpleNamespace

import pytest

from robotctl.control import process
from robotctl.control.shared import Link
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.errors import BusError


def test_an_arm_that_was_not_left_as_it_should_be_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def shut_down() -> None:
        raise BusError("old frames may wait in the kernel", "leave the power of the drives off")

    monkeypatch.setattr(process, "go_real_time", list)
    monkeypatch.setattr(process, "signal_on_parent_death", lambda *_: None)
    loop = SimpleNamespace(
        bring_up=lambda: None,
        bus_statistics=dict,
        closed=True,
        robot=SimpleNamespace(period_ns=2_000_000),
        shut_down=shut_down,
    )
    link = Link.local(7, 10)
    assert process._run(loop, link, MonotonicClock(), SimpleNamespace(operator=0)) == 4
    events = {event["type"]: event for event in link.events.since(0)[0]}
    assert events["error"]["kind"] == "hardware"
    assert "leave the power of the drives off" in events["error"]["text"]
    assert events["bus"]["statistics"] == {}
