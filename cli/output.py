"""Reports for machines."""

import json
from pathlib import Path
from typing import Any

from robotctl.hal.errors import ConfigError


def write_json(path: Path, report: Any) -> None:
    """Write a report as JSON.

    Raises:
        ConfigError: if the file cannot be written.
    """
    try:
        path.write_text(json.dumps(report, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}", "check the folder and the space left") from None
