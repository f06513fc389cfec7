"""Limits of real arms are acknowledged once by their operator, and again whenever they have changed (P25)."""

import json
import os
from pathlib import Path
from urllib.parse import quote

from robotctl.hal.errors import ConfigError
from robotctl.hal.limits_text import difference
from robotctl.hal.robot import Robot

_REMEDY = "read this; if it is what the arm should be held to, run again with --accept-limits"


def state_file(robot: Robot) -> Path:
    """Return where the limits are kept that were acknowledged for a robot of this name."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "robotctl" / "limits" / f"{quote(robot.profile.name, safe='')}.json"


def acknowledge(robot: Robot) -> None:
    """Keep a robot's limits as those that its operator has seen.

    Raises:
        ConfigError: if they cannot be written down.
    """
    path = state_file(robot)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"hash": robot.limits_hash, "limits": robot.limits_text.splitlines()}, indent=1))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}", "set XDG_STATE_HOME to a folder of yours") from None


def require_acknowledged(robot: Robot) -> None:
    """Return if a robot's limits are those that were acknowledged.

    Raises:
        ConfigError: with every line that is new or has changed, if they are not.
    """
    path, name = state_file(robot), robot.profile.name
    try:
        seen = "\n".join(json.loads(path.read_text())["limits"])
    except FileNotFoundError:
        what = f"the limits of {name} have not been acknowledged on this machine:\n{robot.limits_text}"
        raise ConfigError(what, _REMEDY) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}", _REMEDY) from None
    if seen != robot.limits_text:
        what = f"the limits of {name} are not those that were acknowledged:\n{difference(seen, robot.limits_text)}"
        raise ConfigError(what, _REMEDY)
