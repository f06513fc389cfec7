"""How often this machine has written to a drive's flash. The drives do not tell, and their flash wears out."""

import json
import os
from pathlib import Path

from robotctl.hal.errors import ConfigError

PROMISED = 10_000
"""Write cycles that DAMIAO promises."""
MANY = PROMISED // 10
"""Writes from which people are warned."""


def count_writes(protocol: str, serial: int, times: int = 1) -> int:
    """Count writes to a drive's flash, and return how many there were from this machine.

    Raises:
        ConfigError: if that cannot be written down.
    """
    path = _path()
    counts = _read(path)
    key = f"{protocol}:0x{serial:08X}"
    counts[key] = counts.get(key, 0) + times
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_suffix(f".{os.getpid()}")
        fresh.write_text(json.dumps(counts, indent=1, sort_keys=True) + "\n")
        fresh.replace(path)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}", "set XDG_STATE_HOME to a folder of yours") from None
    return counts[key]


def writes(protocol: str, serial: int) -> int:
    """Return how often this machine has written to a drive's flash.

    Raises:
        ConfigError: if the file cannot be read.
    """
    return _read(_path()).get(f"{protocol}:0x{serial:08X}", 0)


def _path() -> Path:
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "robotctl" / "flash.json"


def _read(path: Path) -> dict[str, int]:
    try:
        return {str(key): int(count) for key, count in json.loads(path.read_text()).items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"{path} cannot be read: {error}", "correct it, or move it away: counting starts anew"
        ) from None
