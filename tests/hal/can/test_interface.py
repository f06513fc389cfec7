"""Bit timing and error counters of a kernel interface, as `ip` prints them."""

import pytest

from robotctl.hal.can.interface import interface_findings, read_link
from robotctl.hal.host import Level
from robotctl.hal.profile import CanBus


def link(state="ERROR-ACTIVE", bitrate=1_000_000, point="0.750", restart=100, tx=0, **counted):
    return {
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": state,
                "berr_counter": {"tx": tx, "rx": 0},
                "restart_ms": restart,
                "bittiming": {"bitrate": bitrate, "sample_point": point},
                "data_bittiming": {"bitrate": 5_000_000, "sample_point": "0.750"},
            },
            "info_xstats": counted,
        }
    }


def judge(shown):
    return {finding.name: finding for finding in interface_findings("can0", CanBus(), lambda _: shown)}


def test_an_interface_as_the_profile_says_is_fine():
    found = judge(link())
    assert set(found) == {"bit rate", "data bit rate", "counters"}
    assert {finding.level for finding in found.values()} == {Level.OK}


@pytest.mark.parametrize(
    ("shown", "name", "level", "word"),
    [
        (link(bitrate=500_000), "bit rate", Level.FAIL, "runs at 500 kbit/s"),
        (link(bitrate=0), "bit rate", Level.FAIL, "has none set"),
        (link(point="0.500"), "bit rate", Level.WARN, "0.5"),
        (link(restart=0), "restart", Level.WARN, "stays off"),
        (link(state="BUS-OFF"), "counters", Level.FAIL, "BUS-OFF"),
        (link(tx=96), "counters", Level.WARN, "tx 96"),
        (link(bus_error=7), "counters", Level.WARN, "bus_error 7"),
        ({}, "interface", Level.WARN, "nothing is known"),
    ],
)
def test_what_differs_is_named_with_a_remedy(shown, name, level, word):
    finding = judge(shown)[name]
    assert finding.level is level
    assert word in finding.text
    assert finding.remedy


def test_a_virtual_interface_has_no_bit_rate():
    assert "no bit rate" in judge({"linkinfo": {"info_kind": "vcan"}})["timing"].text


def test_an_interface_that_is_not_there_is_not_known():
    assert read_link("robotctl9") == {}
