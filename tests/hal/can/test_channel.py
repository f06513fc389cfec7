"""Channels by name: which of them other processes reach, and what opening one costs."""

import sys
from pathlib import Path

import can
import pytest

from robotctl.hal.can import channel
from robotctl.hal.clock import MonotonicClock
from robotctl.hal.robot import load_robot


@pytest.mark.parametrize(
    "name", ["socketcan:can0", "slcan:/dev/ttyACM0", "udp_multicast:239.0.0.1", "pcan:PCAN_USBBUS1"]
)
def test_what_other_processes_reach_is_shared(name: str) -> None:
    assert channel.is_shared(name)


@pytest.mark.parametrize("name", ["", "emulated", "virtual:arm", "emulated:x", "slcan:"])
def test_what_lives_in_one_process_is_not(name: str) -> None:
    assert not channel.is_shared(name)


@pytest.mark.parametrize("name", ["socketcan:can0", "slcan:/dev/ttyACM0", "pcan:PCAN_USBBUS1"])
def test_where_drives_may_be_real(name: str) -> None:
    assert channel.may_be_real(name)


def test_no_drives_are_real_at_a_pseudo_terminal_or_a_virtual_interface(tmp_path: Path) -> None:
    link = tmp_path / "adapter"
    link.symlink_to("/dev/pts/0")
    for name in ("", "emulated", "virtual:arm", "slcan:/dev/pts/7", f"slcan:{link}", "socketcan:lo"):
        assert not channel.may_be_real(name), name


@pytest.mark.parametrize("interface", ["slcan", "socketcan"])
def test_after_preparing_nothing_is_left_to_load(interface: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = can.interfaces.BACKENDS[interface][0]
    monkeypatch.delitem(sys.modules, module, raising=False)
    channel.prepare_channel(f"{interface}:anywhere")
    assert module in sys.modules


@pytest.mark.parametrize("name", ["", "emulated", "nonsense:x"])
def test_there_may_be_nothing_to_prepare(name: str) -> None:
    channel.prepare_channel(name)


@pytest.mark.parametrize(("open_it", "settle_s"), [(channel.open_channel, 0.1), (channel.reopen_channel, 0.0)])
def test_a_serial_port_settles_only_when_it_was_closed(open_it, settle_s, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, object] = {}
    real = can.Bus
    monkeypatch.setattr(channel.can, "Bus", lambda **options: asked.update(options) or real("x", "virtual"))
    opened = open_it("slcan:/dev/null", load_robot("openarm"), MonotonicClock())
    opened.bus.shutdown()
    assert asked["sleep_after_open"] == settle_s
