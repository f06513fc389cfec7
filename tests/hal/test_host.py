"""The host's findings: every one has a remedy unless it is fine, and looking changes nothing."""

import os

import pytest

from robotctl.hal.clock import VirtualClock
from robotctl.hal.host import Level, host_findings


def interface(root, name, kind="280", flags="0x1", queue="32"):
    folder = root / name
    folder.mkdir()
    for file, text in (("type", kind), ("flags", flags), ("tx_queue_len", queue), ("operstate", "up")):
        (folder / file).write_text(text + "\n")


def can_findings(root):
    return [finding for finding in host_findings(VirtualClock(), root) if finding.name == "CAN"]


def test_every_problem_has_a_remedy(tmp_path):
    for finding in host_findings(VirtualClock(), tmp_path):
        assert finding.area == "host"
        assert bool(finding.remedy) == (finding.level is not Level.OK)


def test_scheduling_is_left_as_it_was(tmp_path):
    before = os.sched_getscheduler(0)
    host_findings(VirtualClock(), tmp_path)
    assert os.sched_getscheduler(0) == before


def test_only_can_interfaces_count(tmp_path):
    interface(tmp_path, "eth0", kind="1")
    (finding,) = can_findings(tmp_path)
    assert finding.level is Level.WARN


@pytest.mark.parametrize(
    ("flags", "queue", "level", "word"),
    [
        ("0x1", "32", Level.OK, ""),
        ("0x0", "32", Level.WARN, "can0 up"),
        ("0x1", "10", Level.WARN, "txqueuelen"),
        ("0x1", "1000", Level.WARN, "stale"),
    ],
)
def test_interfaces(tmp_path, flags, queue, level, word):
    interface(tmp_path, "can0", flags=flags, queue=queue)
    (finding,) = can_findings(tmp_path)
    assert finding.level is level
    assert word in finding.remedy


def test_a_punctual_clock_is_fine(tmp_path):
    timer = next(finding for finding in host_findings(VirtualClock(), tmp_path) if finding.name == "timer")
    assert timer.level is Level.OK
