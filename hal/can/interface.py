"""How a kernel CAN interface is set up, and what its controller has counted: read with `ip`, changed never."""

import json
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

from robotctl.hal.can.ways import rate_text
from robotctl.hal.host import Finding, Level
from robotctl.hal.profile import CanBus

_SAMPLE_POINT = (0.70, 0.90)
"""Where in a bit the controllers of drives and adapters look; nodes that differ much do not understand each other."""
_TIMEOUT_S = 5.0

Link = dict[str, Any]
"""One entry of `ip -details -statistics -json link show`."""


def read_link(interface: str) -> Link:
    """Return what the kernel tells of an interface; empty if there is none, or no `ip` to ask with."""
    command = ["ip", "-details", "-statistics", "-json", "link", "show", "dev", interface]
    try:
        shown = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=True)
        return dict(json.loads(shown.stdout)[0])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return {}


def interface_findings(interface: str, wiring: CanBus, read: Callable[[str], Link] = read_link) -> Iterator[Finding]:
    """Compare an interface's bit timing with the profile, and look at its controller's counters."""
    link = read(interface)
    if not link:
        yield _finding("interface", Level.WARN, f"nothing is known of {interface}", "install iproute2 (`ip link show`)")
        return
    info = link.get("linkinfo", {})
    if info.get("info_kind") != "can":
        yield _finding(
            "timing", Level.OK, f"{interface} is a {info.get('info_kind', 'network')} interface: no bit rate"
        )
        return
    data = info.get("info_data", {})
    yield from _timing("bit rate", data.get("bittiming", {}), wiring.bitrate, interface)
    if wiring.fd:
        yield from _timing("data bit rate", data.get("data_bittiming", {}), wiring.data_bitrate, interface)
    if not data.get("restart_ms"):
        text = "the controller stays off after bus-off"
        yield _finding("restart", Level.WARN, text, f"ip link set {interface} type can restart-ms 100")
    yield _counters(data, info.get("info_xstats", {}))


def _timing(name: str, timing: dict[str, Any], wanted: int, interface: str) -> Iterator[Finding]:
    rate = int(timing.get("bitrate", 0))
    point = float(timing.get("sample_point", 0.0))
    key = "bitrate" if name == "bit rate" else "dbitrate"
    how = (
        f"ip link set {interface} down; ip link set {interface} up type can {key} {wanted} (docs/can.md has all of it)"
    )
    if not rate:
        yield _finding(name, Level.FAIL, f"{interface} has none set, the profile says {rate_text(wanted)}", how)
        return
    if rate != wanted:
        text = f"{interface} runs at {rate_text(rate)}, the profile says {rate_text(wanted)}"
        yield _finding(name, Level.FAIL, text, how)
        return
    good = _SAMPLE_POINT[0] <= point <= _SAMPLE_POINT[1]
    text = f"{rate_text(rate)}, sample point {point:g}"
    yield _finding(name, Level.OK if good else Level.WARN, text, "set sample-point and dsample-point to 0.75")


def _counters(data: dict[str, Any], counted: dict[str, Any]) -> Finding:
    now = data.get("berr_counter", {})
    state = str(data.get("state", "unknown"))
    text = f"{state}, error counters tx {now.get('tx', '?')} rx {now.get('rx', '?')}"
    past = {key: counted[key] for key in ("bus_error", "error_passive", "bus_off", "restarts") if counted.get(key)}
    if past:
        text += f"; since it came up {', '.join(f'{key} {value}' for key, value in past.items())}"
    level = Level.OK if state == "ERROR-ACTIVE" else Level.FAIL
    if level is Level.OK and (past or now.get("tx") or now.get("rx")):
        level = Level.WARN
    return _finding("counters", level, text, "termination, cable, bit rates; counters go back to 0 as the bus works")


def _finding(name: str, level: Level, text: str, remedy: str = "") -> Finding:
    return Finding("bus", name, level, text, "" if level is Level.OK else remedy)
