"""What a campaign came to: the survivors, which of them are excused, and the figures."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from .campaign import FATES, SURVIVORS, Case

MOST_EXCUSED = 3


class Excuse(NamedTuple):
    """A mutant that may survive, told by what it is, so that it is found again when lines move."""

    file: str
    source: str
    """Its line, without indentation."""
    change: str
    """As the report prints it."""
    reason: str


EXCUSED: tuple[Excuse, ...] = (
    Excuse(
        "guard.py",
        "self._passed = False",
        "False -> True",
        "before the first motion there is no time that could be used up, so nothing is taken off",
    ),
)


def report(done: Sequence[Case], excuses: Sequence[Excuse], seconds: float, path: Path | None = None) -> int:
    """Print survivors and figures, write them to `path`; return the exit status, 0 or 1."""
    survivors = [case for case in done if case.fate in SURVIVORS]
    survivors.sort(key=lambda case: (case.file, case.mutant.line, case.id))
    excused = {
        case.id: e for case in survivors for e in excuses if e[:3] == (case.file, case.source, case.mutant.change)
    }
    for case in survivors:
        label = f"excused: {excused[case.id].reason}" if case.id in excused else case.fate
        print(f"{case.id}  {case.source}\n    {case.mutant.operator}: {case.mutant.change}  ({label})")
    unused = set(excuses) - set(excused.values())
    for excuse in unused:
        print(f"excused, but no such mutant survived: {excuse.file}: {excuse.source}: {excuse.change}")
    if len(excuses) > MOST_EXCUSED:
        print(f"{len(excuses)} survivors are excused; no more than {MOST_EXCUSED} may be")
    fates = Counter(case.fate for case in done)
    figures = {"mutants": len(done)} | {fate: fates[fate] for fate in FATES} | {"excused": len(excused)}
    print(", ".join(f"{count} {name}" for name, count in figures.items()) + f", {seconds:.0f} s")
    if path is not None:
        listed = [
            {"id": case.id, "fate": case.fate, "source": case.source, "operator": case.mutant.operator}
            | {"change": case.mutant.change, "excuse": excused[case.id].reason if case.id in excused else None}
            for case in survivors
        ]
        path.write_text(json.dumps(figures | {"seconds": round(seconds, 1), "survivors": listed}, indent=2) + "\n")
    return 1 if len(survivors) > len(excused) or unused or len(excuses) > MOST_EXCUSED else 0
