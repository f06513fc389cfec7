"""Mutation test of `safety/` by tests/safety: `python -m tests.mutation`, or `make mutation`.

Exit status: 0 if nothing survived but what is excused, 1 if something did or an excuse is out of date, 2 if the
tests fail on the unchanged modules or the command line is wrong.
"""

import argparse
import gc
import os
import sys
import tempfile
import time
from pathlib import Path

# Threads of a linear algebra library do not survive a fork.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

# What every fork would have to import by itself.
import daqp  # noqa: F401
import hypothesis.extra.numpy  # noqa: F401
import mujoco  # noqa: F401
import pinocchio  # noqa: F401
import ruckig  # noqa: F401

import robotctl.hal.robot  # noqa: F401

from . import campaign
from .campaign import SURVIVORS, Case, Package, Survey
from .report import EXCUSED, report

ROOT = Path(__file__).parents[2]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description="Mutation test of safety/.")
    parser.add_argument("--only", nargs="+", metavar="FILE", help="mutate some files of safety/, e.g. shaper.py")
    parser.add_argument("--mutant", metavar="ID", help="run one mutant and show what pytest says, e.g. shaper.py:95#2")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time (default: 2)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures and the survivors")
    options = parser.parse_args()
    package = Package("robotctl.safety", ROOT / "safety", ROOT / "tests/safety", ROOT)
    files = [options.mutant.split(":")[0]] if options.mutant else options.only or list(package.trees)
    for file in files:
        if file not in package.trees:
            parser.error(f"{file} is no file of safety/")
    began = time.monotonic()
    gc.freeze()  # a fork's collector need not look through what it inherits
    try:
        with tempfile.TemporaryDirectory() as compiled:
            sys.pycache_prefix, sys.dont_write_bytecode = compiled, False  # the forks import the same files
            seen = campaign.survey(package)
            todo = campaign.cases(package, seen, files)
            if options.mutant:
                return show_one(package, seen, todo, options.mutant)
            print(f"{len(todo)} mutants, {len(seen.durations)} tests", flush=True)
            done = []
            for case in campaign.run(package, seen, todo, options.jobs):
                done.append(case)
                if case.fate in SURVIVORS:
                    print(f"{case.id} {case.fate}", flush=True)
                elif len(done) % 100 == 0:
                    print(f"{len(done)} of {len(todo)}", flush=True)
    except campaign.UnmutatedTestsFail:
        print("the tests fail on the unchanged modules; look with: python -m pytest tests/safety", file=sys.stderr)
        return 2
    excuses = [excuse for excuse in EXCUSED if excuse.file in files]
    return report(done, excuses, time.monotonic() - began, options.json)


def show_one(package: Package, seen: Survey, todo: list[Case], wanted: str) -> int:
    for case in todo:
        if case.id == wanted:
            print(f"{case.id}  {case.source}\n    {case.mutant.operator}: {case.mutant.change}", flush=True)
            print(campaign.show(package, seen, case))
            return 0
    print(f"no mutant {wanted}; there are {' '.join(case.id for case in todo)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
