"""Runs mutants. Each lives in a process of its own, forked from one that has done the slow imports already.

The mutated module is compiled from its changed tree when the fork imports it, before any test does, so a change
counts everywhere: in constants that others import, in tables, in base classes. The fork runs the tests that execute
a changed line, the module's own and the fastest first, and ends at the first that fails. The lines that a test
executes are found out once, in a survey that runs all tests on the unchanged modules. Time limits are in processor
time, so that a busy machine kills nothing; a fork that runs out of it, or crashes, counts as killed.

mutmut 3.8 is as fast (6 minutes for 1,200 mutants on two cores), but it changes nothing outside functions. The
state table, the gains and the thresholds of `safety/` stand there; and most of its survivors are texts for people.
"""

import ast
import builtins
import contextlib
import importlib.machinery
import importlib.util
import os
import pickle
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import coverage
import hypothesis
import numpy as np
import pytest

from .mutants import Mutant, Place, find, watch

FATES = KILLED, TIMED_OUT, NOT_COVERED, SURVIVED = "killed", "timed out", "not covered", "survived"
SURVIVORS = NOT_COVERED, SURVIVED
_ALLOWANCE_S = 3.0
_SLOWER = 10.0
"""A test may take so many times its usual time, and the allowance, before its mutant counts as hanging."""
_SEE = "__see_sides__"

hypothesis.settings.register_profile(
    "mutation",
    max_examples=25,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
)


@dataclass
class Package:
    """What is mutated, and the tests that have to notice."""

    name: str
    folder: Path
    tests: Path
    root: Path

    def __post_init__(self) -> None:
        files = sorted(self.folder.glob("*.py"))
        self.trees = {path.name: ast.parse(path.read_text()) for path in files}
        self.sources = {path.name: path.read_text().splitlines() for path in files}

    def module(self, file: str) -> str:
        stem = file.removesuffix(".py")
        return self.name if stem == "__init__" else f"{self.name}.{stem}"


@dataclass
class Survey:
    """What a run of all tests on the unchanged modules showed."""

    durations: dict[str, float]
    """Of each test, s."""
    tests: dict[str, dict[int, list[str]]]
    """By file and line: the tests that execute it, "" for what runs outside of tests."""
    integers: dict[str, set[Place]]
    """By file: sides of comparisons that never held anything but integers."""


@dataclass
class Case:
    """One mutant of one file, and how it fared."""

    id: str
    file: str
    source: str
    mutant: Mutant
    fate: str = ""


class UnmutatedTestsFail(Exception):
    """The tests must pass on the unchanged modules, else every mutant would look killed."""


def survey(package: Package) -> Survey:
    """Run all tests once.

    Raises:
        UnmutatedTestsFail: if one of them does not pass.
    """
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "survey"
        _, status = os.waitpid(_fork(lambda: _run_survey(package, answer), quiet=True), 0)
        if status:
            raise UnmutatedTestsFail
        return pickle.loads(answer.read_bytes())


def cases(package: Package, seen: Survey, files: Iterable[str]) -> list[Case]:
    """Return the mutants of some files that make sense; ids are `FILE:LINE#NUMBER`."""
    found = []
    for file in files:
        numbers: dict[int, int] = {}
        for mutant in find(package.trees[file]):
            if mutant.between and not seen.integers[file].issuperset(mutant.between):
                continue
            numbers[mutant.line] = numbers.get(mutant.line, 0) + 1
            name = f"{file}:{mutant.line}#{numbers[mutant.line]}"
            found.append(Case(name, file, package.sources[file][mutant.line - 1].strip(), mutant))
    return found


def run(package: Package, seen: Survey, todo: Iterable[Case], jobs: int) -> Iterator[Case]:
    """Run mutants, `jobs` at a time; yield each when its fate is known.

    Raises:
        UnmutatedTestsFail: if the tests do not pass in the order in which mutants meet them.
    """
    running: dict[int, Case | None] = {_fork(lambda: _run_tests(package, None, seen.durations), quiet=True): None}
    waiting = iter(todo)
    with contextlib.ExitStack() as stack:
        stack.callback(lambda: [os.kill(pid, signal.SIGKILL) for pid in running])
        while True:
            while len(running) < jobs and (case := next(waiting, None)) is not None:
                tests = _tests(case, seen)
                if not tests:
                    case.fate = NOT_COVERED
                    yield case
                    continue
                running[_fork(lambda case=case, tests=tests: _run_tests(package, case, tests), quiet=True)] = case
            if not running:
                return
            pid, status = os.wait()
            case = running.pop(pid)
            fate = _fate(status)
            if case is None:
                if fate != SURVIVED:
                    raise UnmutatedTestsFail
                continue
            case.fate = fate
            yield case


def show(package: Package, seen: Survey, case: Case) -> str:
    """Run one mutant with pytest's output on the screen."""
    _, status = os.waitpid(_fork(lambda: _run_tests(package, case, _tests(case, seen)), quiet=False), 0)
    return _fate(status)


def _tests(case: Case, seen: Survey) -> dict[str, float]:
    """Return the tests that reach a mutant, and their durations."""
    if case.mutant.reach is None:
        return seen.durations
    lines = seen.tests[case.file]
    reaching = {test for line in case.mutant.reach for test in lines.get(line, [])}
    # What runs outside any test was made for all tests of a module, or for many by a fixture.
    return seen.durations if "" in reaching else {test: seen.durations[test] for test in reaching}


def _fate(status: int) -> str:
    if os.WIFSIGNALED(status):
        return TIMED_OUT if os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGVTALRM) else KILLED
    match os.WEXITSTATUS(status):
        case pytest.ExitCode.OK:
            return SURVIVED
        case pytest.ExitCode.TESTS_FAILED | pytest.ExitCode.INTERRUPTED:  # the latter: it could not be imported
            return KILLED
        case code:
            msg = f"a fork ended with {code}: run that mutant alone with --mutant ID"
            raise RuntimeError(msg)


# -- in the fork -------------------------------------------------------------------------------------------------------


def _fork(work: Callable[[], int], *, quiet: bool) -> int:
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        if quiet:
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
        code = work()
    finally:
        os._exit(code)


def _run_tests(package: Package, case: Case | None, tests: dict[str, float]) -> int:
    """Run the module's own tests, and the others only if these notice nothing."""
    own = ""
    if case is not None:
        case.mutant.apply()
        _import_from_trees(package, {case.file: package.trees[case.file]})
        own = f"test_{case.file.removesuffix('.py')}"
    first = {test: seconds for test, seconds in tests.items() if Path(_file(test)).name.startswith(own)}
    code = 0
    for part in (first, {test: seconds for test, seconds in tests.items() if test not in first}):
        if part and not code:
            files = sorted({_file(test) for test in part})
            signal.setitimer(signal.ITIMER_PROF, 10.0 * _ALLOWANCE_S)
            code = _pytest(package, [str(package.root / file) for file in files], _Selection(part))
    return code


def _file(test: str) -> str:
    return test.split("::")[0]


def _run_survey(package: Package, answer: Path) -> int:
    always: dict[str, dict[Place, bool]] = {file: {} for file in package.trees}

    def see(file: str, where: Place, side: Any) -> Any:
        if always[file].get(where, True):
            always[file][where] = np.asarray(side).dtype.kind in "biu"
        return side

    setattr(builtins, _SEE, see)
    _import_from_trees(package, {file: watch(tree, _SEE, file) for file, tree in package.trees.items()})
    measured = coverage.Coverage(data_file=None, config_file=False, source=[str(package.folder.resolve())])
    measured.start()
    watcher = _Stopwatch(measured)
    code = _pytest(package, [str(package.tests)], watcher)
    measured.stop()
    data = measured.get_data()
    tests = {file: data.contexts_by_lineno(str((package.folder / file).resolve())) for file in package.trees}
    integers = {file: {where for where, integer in sides.items() if integer} for file, sides in always.items()}
    answer.write_bytes(pickle.dumps(Survey(watcher.durations, tests, integers)))
    return code


def _pytest(package: Package, where: list[str], plugin: object) -> int:
    hypothesis.settings.load_profile("mutation")
    off = [f"-pno:{name}" for name in ("cacheprovider", "unraisableexception", "xdist")]  # the second collects garbage
    return pytest.main(["-x", "-q", "--tb=short", f"--rootdir={package.root}", *off, *where], plugins=[plugin])


class _Selection:
    """Picks tests and puts the fastest first; gives each its time."""

    def __init__(self, tests: dict[str, float]) -> None:
        self._durations = tests

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        chosen = [item for item in items if item.nodeid in self._durations]
        items[:] = sorted(chosen, key=lambda item: self._durations[item.nodeid])

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        signal.setitimer(signal.ITIMER_PROF, _ALLOWANCE_S + _SLOWER * self._durations[nodeid])


class _Stopwatch:
    """Notes how long each test takes, and tells coverage which one it is."""

    def __init__(self, measured: coverage.Coverage) -> None:
        self._measured = measured
        self.durations: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._measured.switch_context(item.nodeid)
        began = time.perf_counter()
        result = yield
        self.durations[item.nodeid] = time.perf_counter() - began
        self._measured.switch_context("")
        return result


def _import_from_trees(package: Package, trees: dict[str, ast.Module]) -> None:
    """Let imports of these files take their code from the trees instead."""
    paths = {package.module(file): str((package.folder / file).resolve()) for file in trees}
    codes = {package.module(file): compile(trees[file], paths[package.module(file)], "exec") for file in trees}

    class Loader(importlib.machinery.SourceFileLoader):
        def get_code(self, fullname: str) -> Any:
            return codes[fullname]

    class Finder(importlib.machinery.PathFinder):
        @classmethod
        def find_spec(cls, fullname: str, path: Any = None, target: Any = None) -> Any:
            if fullname not in codes:
                return None
            loader = Loader(fullname, paths[fullname])
            return importlib.util.spec_from_file_location(fullname, paths[fullname], loader=loader)

    assert not set(codes) & set(sys.modules), "imported before it could be mutated"
    sys.meta_path.insert(0, Finder)
