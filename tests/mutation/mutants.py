"""What is changed: the small mistakes that somebody could have made in a module, as changes of its syntax tree.

| operator   | change                                                                                        |
|------------|-----------------------------------------------------------------------------------------------|
| comparison | `<` to `>=`, `==` to `!=`, `is` to `is not`, `in` to `not in`, and back                       |
| tie        | `<` to `<=`, `>` to `>=`, and back                                                            |
| logic      | `and` to `or` and back; one operand left out; `not` dropped                                   |
| arithmetic | `+` to `-`, `*` to `/`, `&` to `|` and back; `**` and `%` to `*`; unary minus and abs dropped |
| number     | x + 1 for integers, 1.5 x for floats and from 1000 on, 1.0 for 0.0, True to False and back    |
| extremum   | min to max, all to any, and back, and numpy's relatives of these                              |
| return     | `return X` to `return None`                                                                   |
| deletion   | a statement that assigns or calls                                                             |
| branch     | `if c` to `if not c`, also in `while`, in comprehensions and in guards of cases               |
| table      | one entry left out of a table outside functions, of a tuple behind `in`, of a case            |

A tie is moved only between integers: nanoseconds, counters, enumerations. A tie of two floats practically never
occurs, and what a limit does one rounding error further on is no promise of ours. Which operands are integers is
not guessed from names but seen while the tests run (`watch`).

Left alone is what means nothing at run time, or is there for people: annotations, strings, what is raised, `strict` of
zip, abstract methods, protocols, and the numbers of enumerations.
"""

import ast
import copy
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.Gt: ast.LtE,
    ast.Eq: ast.NotEq,
    ast.Is: ast.IsNot,
    ast.In: ast.NotIn,
}
COMPARISONS |= {after: before for before, after in COMPARISONS.items()}
TIES: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.LtE, ast.Gt: ast.GtE, ast.LtE: ast.Lt, ast.GtE: ast.Gt}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
EXTREMA = {"min": "max", "minimum": "maximum", "argmin": "argmax", "all": "any"}
EXTREMA |= {after: before for before, after in EXTREMA.items()}
MAGNITUDES = {"abs", "fabs"}
LARGE = 1000
"""From here on an integer is a quantity, as nanoseconds are."""
ENUMERATIONS = {"Enum", "IntEnum", "Flag", "IntFlag", "StrEnum"}

Place = tuple[int, int, int | None, int | None]
"""Where an expression begins and ends in its file."""


class Change(NamedTuple):
    """What could stand in place of a node."""

    operator: str
    after: Any
    left_out: ast.AST | None = None
    between: tuple[Place, Place] | None = None
    """For a tie: its two operands."""


@dataclass
class Mutant:
    """One change of one module."""

    operator: str
    line: int
    change: str
    """Before and after, as source."""
    reach: set[int] | None
    """Lines of which a test has to execute one to notice; None where the change works on import."""
    between: tuple[Place, Place] | None
    """For a tie: its two operands."""
    _owner: ast.AST
    _field: str
    _index: int | None
    _after: ast.AST

    def apply(self) -> None:
        """Change the tree that the mutant was found in, for good."""
        if self._index is None:
            setattr(self._owner, self._field, self._after)
        else:
            getattr(self._owner, self._field)[self._index] = self._after


def find(tree: ast.Module) -> list[Mutant]:
    """Return all mutants of a module, in the order of its lines."""
    return sorted(_below(tree, None, None), key=lambda mutant: mutant.line)


def watch(tree: ast.Module, see: str, label: str) -> ast.Module:
    """Return a copy of a module that takes the sides of ordering comparisons from `see(label, place, side)`."""

    class Watcher(ast.NodeTransformer):
        def visit_Compare(self, node: ast.Compare) -> ast.Compare:
            places = [place(side) for side in (node.left, *node.comparators)]
            self.generic_visit(node)
            sides = [
                ast.Call(ast.Name(see, ast.Load()), [ast.Constant(label), ast.Constant(where), side], [])
                for where, side in zip(places, (node.left, *node.comparators), strict=True)
            ]
            ordering = all(type(op) in TIES for op in node.ops)
            return ast.copy_location(ast.Compare(sides[0], node.ops, sides[1:]), node) if ordering else node

    return ast.fix_missing_locations(Watcher().visit(copy.deepcopy(tree)))


def place(node: ast.expr) -> Place:
    return node.lineno, node.col_offset, node.end_lineno, node.end_col_offset


def _below(node: ast.AST, function: ast.AST | None, statement: ast.stmt | None) -> Iterator[Mutant]:
    """Yield the mutants below `node`, which stands in `function` and `statement`, the innermost ones round it."""
    for field, value in ast.iter_fields(node):
        if field == "body" and isinstance(node, ast.FunctionDef):
            function = node
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST) or _left_alone(child, node, field):
                continue
            here = child if isinstance(child, ast.stmt) else statement
            reach = None if function is None else _lines(child, here)
            sought = isinstance(node, ast.Compare) and isinstance(node.ops[-1], ast.In | ast.NotIn)
            for change in _changes(child, field, table=sought or (function is None and field != "keys")):
                after = ast.fix_missing_locations(ast.copy_location(change.after, child))
                text = f"without {ast.unparse(change.left_out)}" if change.left_out else _arrow(child, after)
                line = getattr(change.left_out or child, "lineno", 0)
                yield Mutant(change.operator, line, text, reach, change.between, node, field, index, after)
            yield from _below(child, function, here)


def _left_alone(node: ast.AST, owner: ast.AST, field: str) -> bool:
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.expr_context() | ast.operator() | ast.cmpop() | ast.alias():
            return True
        case ast.ClassDef(bases=bases):
            return any(_name(base) == "Protocol" for base in bases)
        case ast.keyword(arg="strict"):  # of zip: an assertion
            return True
        case ast.FunctionDef(decorator_list=decorators):
            return any(_name(decorator) == "abstractmethod" for decorator in decorators)
        case ast.Assign(targets=targets) if isinstance(owner, ast.ClassDef):
            return _name(targets[0]) == "__slots__" or any(_name(base) in ENUMERATIONS for base in owner.bases)
    return field in ("annotation", "returns", "decorator_list", "bases")


def _changes(node: Any, field: str, *, table: bool) -> Iterator[Change]:
    def altered(**fields: Any) -> Any:
        return type(node)(**(dict(ast.iter_fields(node)) | fields))

    match node:
        case ast.Compare(left=left, ops=ops, comparators=comparators):
            places = [place(side) for side in (left, *comparators)]
            for i, op in enumerate(ops):
                yield Change("comparison", altered(ops=[*ops[:i], COMPARISONS[type(op)](), *ops[i + 1 :]]))
                if type(op) in TIES:
                    after = altered(ops=[*ops[:i], TIES[type(op)](), *ops[i + 1 :]])
                    yield Change("tie", after, between=(places[i], places[i + 1]))
        case ast.BoolOp(op=op, values=values):
            yield Change("logic", altered(op=ast.Or() if isinstance(op, ast.And) else ast.And()))
            for item, rest in _each_left_out(values):
                yield Change("logic", altered(values=rest) if len(rest) > 1 else rest[0], item)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield Change("logic", operand)
        case ast.UnaryOp(op=ast.USub() | ast.Invert(), operand=operand):
            yield Change("arithmetic", operand)
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in ARITHMETIC:
            yield Change("arithmetic", altered(op=ARITHMETIC[type(op)]()))
        case ast.Constant(value=bool(value)):
            yield Change("number", ast.Constant(not value))
        case ast.Constant(value=int(value)):
            yield Change("number", ast.Constant(value + 1 if value < LARGE else value * 3 // 2))
        case ast.Constant(value=float(value)):
            yield Change("number", ast.Constant(1.5 * value or 1.0))
        case ast.Call(func=function) if (name := _name(function)) in EXTREMA:
            if isinstance(function, ast.Name):
                yield Change("extremum", altered(func=ast.Name(EXTREMA[name], ast.Load())))
            else:
                yield Change("extremum", altered(func=ast.Attribute(function.value, EXTREMA[name], ast.Load())))
        case ast.Call(func=function, args=arguments) if _name(function) in MAGNITUDES:
            yield Change("arithmetic", arguments[0])
        case ast.Return(value=ast.Constant(value=value)) if not value:
            pass  # None is as good
        case ast.Return(value=ast.expr()):
            yield Change("return", ast.Return(ast.Constant(None)))
        case ast.MatchOr(patterns=patterns):
            for item, rest in _each_left_out(patterns):
                yield Change("table", altered(patterns=rest) if len(rest) > 1 else rest[0], item)
        case ast.Tuple(elts=elements, ctx=ast.Load()) | ast.List(elts=elements) | ast.Set(elts=elements) if table:
            for item, rest in _each_left_out(elements):
                yield Change("table", altered(elts=rest), item)
        case ast.Dict(keys=keys, values=values) if table:
            for (key, other_keys), (value, others) in zip(_each_left_out(keys), _each_left_out(values), strict=True):
                yield Change("table", altered(keys=other_keys, values=others), key or value)
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Expr) and not _is_bare(node):
        yield Change("deletion", ast.Pass())
    if field in ("test", "guard", "ifs") and not _negated_already(node):
        yield Change("branch", ast.UnaryOp(ast.Not(), node))


def _each_left_out(items: list[Any]) -> Iterator[tuple[Any, list[Any]]]:
    return ((item, items[:i] + items[i + 1 :]) for i, item in enumerate(items))


def _is_bare(statement: ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Expr) -> bool:
    """Whether it declares or documents, but does nothing."""
    return statement.value is None or (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant))


def _negated_already(test: ast.expr) -> bool:
    """Whether another operator makes the same mutant."""
    single = isinstance(test, ast.Compare) and len(test.ops) == 1
    return single or (isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not))


def _lines(node: ast.AST, statement: ast.stmt | None) -> set[int]:
    """Of a plain statement all lines; of a statement with a body those of the expression, and its own first."""
    assert statement is not None
    whole = node if hasattr(statement, "body") or hasattr(statement, "cases") else statement
    first = getattr(whole, "lineno", statement.lineno)
    return {statement.lineno, *range(first, getattr(whole, "end_lineno", first) + 1)}


def _name(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _arrow(before: ast.AST, after: ast.AST) -> str:
    return " -> ".join(textwrap.shorten(ast.unparse(node), 100, placeholder="...") for node in (before, after))
