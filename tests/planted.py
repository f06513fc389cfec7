"""Ten mistakes that people make with a new arm, planted in emulated drives, and what has to be said of each.

Shared by the tests over a pseudo-terminal and over the kernel's vcan, which cannot show the same things.
"""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

START_S = 60.0
SWAP = [
    "--register=openarm_right_joint2:ESC_ID=3",
    "--register=openarm_right_joint2:MST_ID=0x13",
    "--register=openarm_right_joint3:ESC_ID=2",
    "--register=openarm_right_joint3:MST_ID=0x12",
]


class Mistake(NamedTuple):
    """What is planted, and the finding of `doctor` that has to name it."""

    name: str
    options: list[str]
    area: str
    finding: str
    """Begin of the finding's name."""
    level: str
    words: tuple[str, ...]
    """All of these are in text or remedy."""


MISTAKES = [
    Mistake("bit rate", ["--register=all:can_br=3"], "bus", "bit rate", "fail", ("500 kbit/s", "0x01", "0x08")),
    Mistake("termination", ["--trouble=unterminated:all:0.1"], "bus", "termination", "fail", ("60 Ohm",)),
    Mistake("CAN FD", ["--register=all:can_br=9"], "bus", "CAN FD", "fail", ("answers on CAN FD", "can_br")),
    Mistake(
        "duplicate id",
        ["--register=openarm_right_joint2:MST_ID=0x11", "--register=openarm_right_joint2:ESC_ID=1"],
        "drives",
        "openarm_right_joint1",
        "fail",
        ("2 motors share this id",),
    ),
    Mistake("watchdog", ["--register=3:TIMEOUT=0"], "drives", "openarm_right_joint3", "fail", ("no watchdog",)),
    Mistake("zero", ["--trouble=zero:4:-2.0"], "drives", "openarm_right_joint4", "fail", ("its zero is wrong",)),
    Mistake("model", ["--register=3:VMAX=8"], "drives", "openarm_right_joint3", "fail", ("12.5 / 8 / 28", "DM4340")),
    Mistake(
        "voltage",
        ["--trouble=undervoltage:5:11"],
        "drives",
        "openarm_right_joint5",
        "fail",
        ("UNDER_VOLTAGE", "11.0 V", "it needs 15.0"),
    ),
    Mistake(
        "swapped ids", SWAP, "drives", "openarm_right_joint2", "fail", ("swapped with openarm_right_joint3 (0x03)",)
    ),
    Mistake(
        "dead motor",
        ["--trouble=powercut:6"],
        "drives",
        "openarm_right_joint6",
        "fail",
        ("does not answer", "the others do"),
    ),
]


class Emulator:
    """`robotctl emulate` in a process of its own."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.report = folder / "emulate.json"
        self.report.unlink(missing_ok=True)
        command = [sys.executable, "-m", "robotctl.cli.main", "emulate", "--json", str(self.report), *options]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def __enter__(self) -> Self:
        deadline = time.monotonic() + START_S
        while not self.report.exists():
            assert self._process.poll() is None, "the emulator ended before it served"
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        self._process.wait(20)

    @property
    def channel(self) -> str:
        return json.loads(self.report.read_text())["channel"].split(", ")[0]


def verdicts(findings: list[dict], mistake: Mistake) -> list[dict]:
    """Return the findings that name a mistake."""
    return [
        finding
        for finding in findings
        if (finding["area"], finding["level"]) == (mistake.area, mistake.level)
        and finding["name"].startswith(mistake.finding)
        and all(word in finding["text"] + finding["remedy"] for word in mistake.words)
    ]
