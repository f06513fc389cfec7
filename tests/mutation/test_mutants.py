"""What is mutated, and what is left alone."""

import ast

import pytest

from .mutants import find, watch


def changes(source):
    return [mutant.change for mutant in find(ast.parse(source))]


def mutated(source):
    """Return the whole module after each of its mutants."""
    count = len(find(ast.parse(source)))
    results = []
    for number in range(count):
        tree = ast.parse(source)
        find(tree)[number].apply()
        compile(tree, "mutated", "exec")
        results.append(ast.unparse(tree))
    return results


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("f(a < b)", {"pass", "f(a >= b)", "f(a <= b)"}),
        ("f(a >= b)", {"pass", "f(a < b)", "f(a > b)"}),
        ("f(a == b)", {"pass", "f(a != b)"}),
        ("f(a is not b)", {"pass", "f(a is b)"}),
        ("f(a < b < c)", {"pass", "f(a >= b < c)", "f(a <= b < c)", "f(a < b >= c)", "f(a < b <= c)"}),
        ("f(a and b)", {"pass", "f(a or b)", "f(a)", "f(b)"}),
        ("f(not a)", {"pass", "f(a)"}),
        ("f(a + b)", {"pass", "f(a - b)"}),
        ("f(a * b)", {"pass", "f(a / b)"}),
        ("f(a ** b)", {"pass", "f(a * b)"}),
        ("f(-a)", {"pass", "f(a)"}),
        ("f(np.abs(a))", {"pass", "f(a)"}),
        ("f(2)", {"pass", "f(3)"}),
        ("f(2.0)", {"pass", "f(3.0)"}),
        ("f(1_000_000)", {"pass", "f(1_500_000)"}),
        ("f(0.0)", {"pass", "f(1.0)"}),
        ("f(True)", {"pass", "f(False)"}),
        ("f(min(a, b))", {"pass", "f(max(a, b))"}),
        ("f(np.minimum(a, b))", {"pass", "f(np.maximum(a, b))"}),
        ("f(a.all())", {"pass", "f(a.any())"}),
        ("a |= b", {"pass", "a &= b"}),
        ("a: int = b", {"pass"}),
        ("a = {b: c, **d}", {"pass", "a = {**d}", "a = {b: c}"}),
        ("f(a in (b, c))", {"pass", "f(a not in (b, c))", "f(a in (c,))", "f(a in (b,))"}),
    ],
)
def test_operators(source, expected):
    assert set(mutated(source)) == {ast.unparse(ast.parse(text)) for text in expected}


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("return a", {"return None"}),
        ("return False", {"return True"}),
        ("if a:\n  f", {"if not a:\n  f"}),
        ("if not a:\n  f", {"if a:\n  f"}),
        ("while a:\n  f", {"while not a:\n  f"}),
        ("return (a, b)", {"return None"}),
        ("return [a for b in c if d]", {"return None", "return [a for b in c if not d]"}),
        ("return a if b else c", {"return None", "return a if not b else c"}),
        ("match a:\n  case B() | C():\n   f", {"match a:\n  case C():\n   f", "match a:\n  case B():\n   f"}),
        ("match a:\n  case B() if c:\n   f", {"match a:\n  case B() if not c:\n   f"}),
    ],
)
def test_operators_in_functions(body, expected):
    found = set(mutated(f"def g():\n {body}"))
    deletions = {text for text in found if "pass" in text}
    assert found - deletions == {ast.unparse(ast.parse(f"def g():\n {text}")) for text in expected}


@pytest.mark.parametrize(
    "source",
    [
        '"""Docstring."""',
        "import a",
        "def f(a: int | None) -> int | None: ...",
        "a: tuple[int, float]",
        "def f(): raise E(1 + 2 < 3)",
        "def f():\n for a in zip(b, strict=True): ...",
        "class A(IntEnum):\n B = 1\n C = -2",
        "class A:\n __slots__ = ('a', 'b')",
        "class A(Protocol):\n def f(self):\n  return 1 + 2",
        "class A(ABC):\n @abstractmethod\n def f(self):\n  return 1 + 2",
        "def f():\n return None",
        "def f():\n return ''",
    ],
)
def test_left_alone(source):
    assert changes(source) == []


def test_texts_are_left_alone_but_not_what_chooses_them():
    assert changes("def f():\n return f'{a + 1:.3f}' if b else 'c'") == [
        "return f'{a + 1:.3f}' if b else 'c' -> return None",
        "b -> not b",
    ]


def test_methods_of_enumerations_are_mutated():
    assert changes("class A(IntEnum):\n B = 1\n def f(self):\n  return self.value + 1")


def test_reach_is_the_statement_or_the_head_of_a_block():
    source = "A = 1\ndef f(b=2):\n  c = (3 +\n    d)\n  if (e\n      and g):\n    return h(\n      4)"
    reach = {mutant.change: mutant.reach for mutant in find(ast.parse(source))}
    assert reach["1 -> 2"] is None
    assert reach["2 -> 3"] is None  # defaults are made on import
    assert reach["3 + d -> 3 - d"] == {3, 4}
    assert reach["e and g -> e or g"] == {5, 6}
    assert reach["4 -> 5"] == {7, 8}


def test_watching_changes_nothing_and_sees_both_sides_of_every_comparison():
    source = "def f(a, b):\n return [a < b, a < b < 9, a == b, (a < b) > c(a >= 2)]\nc = int"
    tree, seen = ast.parse(source), []

    def see(label, place, side):
        seen.append((label, place[:2], side))
        return side

    plain, watched = {}, {"see": see}
    exec(source, plain)
    exec(compile(watch(tree, "see", "file"), "watched", "exec"), watched)
    assert watched["f"](3, 4.0) == plain["f"](3, 4.0)
    assert ast.unparse(tree) == ast.unparse(ast.parse(source))
    assert ("file", (2, 9), 3) in seen
    assert ("file", (2, 13), 4.0) in seen
    assert len(seen) == 2 + 3 + 2 + 2 + 2
    ties = [mutant.between for mutant in find(tree) if mutant.operator == "tie"]
    assert {tie[0][:2] for tie in ties} <= {place for _, place, _ in seen}
