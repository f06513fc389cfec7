"""What this machine offers a control loop. Reads the system; changes nothing that outlives the call."""

import os
import platform
import resource
import sys
import time
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from robotctl.hal.clock import Clock

NETWORK = Path("/sys/class/net")
_ARPHRD_CAN = "280"
"""Device type of CAN interfaces in /sys/class/net/*/type."""

_QUEUE = (16, 128)
"""Frames: fewer fail at once (8 motors ask and answer), more only hold stale commands."""

_MEMLOCK = 64 << 20
_LATE_US = 500.0
_PROBES = 200
_PROBE_NS = 1_000_000


class Level(StrEnum):
    """How bad a finding is. Only FAIL changes an exit status."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


class Finding(NamedTuple):
    """One thing that was looked at."""

    area: str
    """host, profile or drives"""
    name: str
    level: Level
    text: str
    remedy: str = ""


def host_findings(clock: Clock, network: Path = NETWORK) -> list[Finding]:
    """Look at the interpreter, the kernel, its CAN interfaces and its punctuality. Takes about 0.2 s."""
    return [
        _finding("python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer"),
        _finding("kernel", True, f"{platform.system()} {platform.release()}{_realtime_note()}"),
        *_can_findings(network),
        _finding(
            "SCHED_FIFO",
            _may_use_fifo(),
            "real-time priority is " + ("allowed" if _may_use_fifo() else "not allowed"),
            "add `@robot - rtprio 80` to /etc/security/limits.d and log in again; without it, load delays the loop",
        ),
        _memlock_finding(),
        _cores_finding(),
        _finding(
            "clock",
            time.get_clock_info("monotonic").resolution <= 1e-6,
            f"resolution {time.get_clock_info('monotonic').resolution * 1e9:g} ns",
            "the kernel lacks high-resolution timers",
        ),
        _lateness_finding(clock),
    ]


def _finding(name: str, good: bool, text: str, remedy: str = "") -> Finding:
    return Finding("host", name, Level.OK if good else Level.WARN, text, "" if good else remedy)


def _realtime_note() -> str:
    return ", PREEMPT_RT" if "PREEMPT_RT" in platform.version() else ""


def _can_findings(network: Path) -> list[Finding]:
    interfaces = sorted(path for path in network.glob("*") if _read(path / "type") == _ARPHRD_CAN)
    if interfaces:
        return [_interface_finding(path) for path in interfaces]
    known = Path("/proc/net/can").exists() or Path("/sys/module/can").exists()
    what = "the kernel knows CAN, but there is no interface" if known else "no CAN in this kernel"
    remedy = "load the adapter's driver, or `modprobe can-raw vcan`; emulated and slcan channels work without"
    return [_finding("CAN", False, what, remedy)]


def _interface_finding(path: Path) -> Finding:
    state = _read(path / "operstate") or "unknown"
    queue = int(_read(path / "tx_queue_len") or 0)
    text = f"{path.name}: {state}, queue of {queue} frames"
    if not int(_read(path / "flags") or "0", 16) & 1:
        return _finding("CAN", False, text, f"ip link set {path.name} up")
    remedy = f"ip link set {path.name} txqueuelen 32: shorter ones fill at once, longer ones hold stale commands"
    return _finding("CAN", _QUEUE[0] <= queue <= _QUEUE[1], text, remedy)


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def _may_use_fifo() -> bool:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, policy, parameters)
    return True


def _memlock_finding() -> Finding:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = limit == resource.RLIM_INFINITY
    text = "unlimited" if unlimited else f"{limit / (1 << 20):g} MiB"
    remedy = "add `@robot - memlock unlimited` to /etc/security/limits.d; paged-out memory delays the loop"
    return _finding("memlock", unlimited or limit >= _MEMLOCK, text, remedy)


def _cores_finding() -> Finding:
    cores = len(os.sched_getaffinity(0))
    remedy = "give the control process a core of its own: close other work, or use a machine with more cores"
    return _finding("cores", cores >= 4, f"{cores} usable", remedy)


def _lateness_finding(clock: Clock) -> Finding:
    late = []
    for _ in range(_PROBES):
        deadline = clock.now_ns() + _PROBE_NS
        clock.sleep_until(deadline)
        late.append((clock.now_ns() - deadline) * 1e-3)
    late.sort()
    p99 = late[_PROBES * 99 // 100]
    text = f"{_PROBES} sleeps of 1 ms ended late by {late[_PROBES // 2]:.0f} us (p50), {p99:.0f} us (p99)"
    return _finding("timer", p99 < _LATE_US, text, "stop other work on this machine, and allow SCHED_FIFO")
