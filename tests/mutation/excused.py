"""Survivors that no test can kill, each with the reason."""

from typing import NamedTuple

MOST = 3


class Excuse(NamedTuple):
    """One mutant that may survive, named so that it is found again when lines move."""

    file: str
    source: str
    """Its line, without indentation."""
    change: str
    reason: str


EXCUSED: tuple[Excuse, ...] = ()
