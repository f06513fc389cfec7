"""A toy package with known mutants, and tests that let known ones live."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from .campaign import Case
from .mutants import Mutant
from .report import Excuse, report

ROOT = Path(__file__).parents[2]
GATE = '''"""Lets a few slow things in."""

LIMIT = 3


def passes(count, speed):
    return count < LIMIT and speed < 0.5


def countdown(count):
    while count > 0:
        count -= 1
    return count


def twice(count):
    return count + count


def unused(count):
    return -count
'''
TESTS = """
from toy.gate import LIMIT, countdown, passes, twice

FOUR = twice(2)  # outside of the test that uses it

def test_passes():
    assert LIMIT  # a changed constant is changed here, too
    assert passes(2, 0.4)
    assert not passes(3, 0.4)
    assert not passes(2, 0.8)

def test_twice():
    assert FOUR == 4

def test_countdown():
    assert countdown(3) == 0
"""
CAMPAIGN = """
import json, sys
from pathlib import Path
from tests.mutation import campaign
here = Path(sys.argv[1])
sys.path.insert(0, sys.argv[1])
campaign._ALLOWANCE_S = 0.3
package = campaign.Package("toy", here / "toy", here / "tests", here)
try:
    seen = campaign.survey(package)
    done = list(campaign.run(package, seen, campaign.cases(package, seen, package.trees), 2))
    print(json.dumps([[case.id, case.mutant.change, case.fate] for case in done]))
except campaign.UnmutatedTestsFail:
    print(json.dumps("refused"))
"""


def campaign(folder, tests):
    (folder / "toy").mkdir()
    (folder / "tests").mkdir()
    (folder / "toy/__init__.py").touch()
    (folder / "toy/gate.py").write_text(GATE)
    (folder / "tests/test_gate.py").write_text(tests)
    command = [sys.executable, "-c", CAMPAIGN, str(folder)]
    return json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)


def test_a_campaign(tmp_path):
    done = campaign(tmp_path, TESTS)
    assert len({case for case, _, _ in done}) == len(done) == 21
    fates = {change: fate for _, change, fate in done}
    lived = {change: fate for change, fate in fates.items() if fate != "killed"}
    assert lived == {
        "0.5 -> 0.75": "survived",
        "count -= 1 -> count += 1": "timed out",
        "count -= 1 -> pass": "timed out",
        "-count -> count": "not covered",
        "return -count -> return None": "not covered",
    }
    assert "count < LIMIT -> count <= LIMIT" in fates  # a tie of integers
    assert "speed < 0.5 -> speed <= 0.5" not in fates  # and one of floats


def test_tests_that_fail_anyway_kill_nothing(tmp_path):
    assert campaign(tmp_path, TESTS + "    assert False\n") == "refused"


def a_case(fate, change="1 -> 2"):
    return Case(
        f"gate.py:7#{change[-1]}",
        "gate.py",
        "return 1",
        Mutant("number", 7, change, None, None, None, "", None, None),
        fate,
    )


EXCUSE = Excuse("gate.py", "return 1", "1 -> 2", "nobody can tell")


@pytest.mark.parametrize(
    ("fate", "excuses", "status", "text"),
    [
        ("killed", [], 0, "1 killed"),
        ("timed out", [], 0, "1 timed out"),
        ("survived", [], 1, "gate.py:7#2  return 1"),
        ("not covered", [], 1, "1 -> 2  (not covered)"),
        ("survived", [EXCUSE], 0, "excused: nobody can tell"),
        ("killed", [EXCUSE], 1, "no such mutant survived: gate.py: return 1: 1 -> 2"),
        ("survived", [EXCUSE._replace(change="1 -> 3")], 1, "no such mutant survived"),
    ],
)
def test_only_what_is_excused_may_survive(capsys, fate, excuses, status, text):
    assert report([a_case(fate)], excuses, 1.0) == status
    assert text in capsys.readouterr().out


def test_no_more_than_three_are_excused():
    done = [a_case("survived", f"1 -> {number}") for number in range(4)]
    excuses = [EXCUSE._replace(change=f"1 -> {number}") for number in range(4)]
    assert report(done[:3], excuses[:3], 1.0) == 0
    assert report(done, excuses, 1.0) == 1


def test_the_report_as_json(tmp_path):
    report([a_case("survived"), a_case("killed", "1 -> 3")], [EXCUSE], 1.0, tmp_path / "report.json")
    found = json.loads((tmp_path / "report.json").read_text())
    assert (found["mutants"], found["killed"], found["survived"], found["excused"]) == (2, 1, 1, 1)
    (survivor,) = found["survivors"]
    assert (survivor["id"], survivor["change"], survivor["excuse"]) == ("gate.py:7#2", "1 -> 2", "nobody can tell")
