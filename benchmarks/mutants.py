"""Small faults put into formulas: what `mutation.py` makes of a source file, one change at a time.

Types, docstrings, texts, what is raised or said, and numbers that merely keep a division from
failing are left alone: such changes would mean the same.
"""

from __future__ import annotations

import ast
import copy
import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

GUARD = 1e-5
"""Numbers below this only keep a division or a logarithm from failing."""
PLAIN_KEYWORDS = {"axis", "keepdims", "dtype", "strict", "initial", "compare", "init", "repr"}
"""Arguments that are no part of a formula."""
SPOKEN = {"debug", "info", "warning", "print", "check"}
"""Calls that only speak or refuse."""
ARITHMETIC: Mapping[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
COMPARISONS: Mapping[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
PAIRS = {
    "maximum": "minimum",
    "max": "min",
    "nanmax": "nanmin",
    "argmax": "argmin",
    "any": "all",
    "sin": "cos",
    "floor": "ceil",
    "log1p": "expm1",
    "mean": "median",
    "nanmean": "nanmedian",
    "zeros_like": "ones_like",
}
"""Functions that take each other's place."""
INSTEAD = {
    **PAIRS,
    **{other: name for name, other in PAIRS.items()},
    "exp": "expm1",
    "hypot": "maximum",
    "cumsum": "cumprod",
    "logaddexp": "maximum",
}
"""Functions and what takes their place."""
LEFT_OUT = {"sqrt", "abs", "clip", "nan_to_num", "sign", "log_of", "sort"}
"""Functions whose first argument may stand in their place."""
Change = tuple[str, ast.AST]


@dataclass(frozen=True)
class Mutant:
    """One small change of a file.

    Attributes:
        file: The file, relative to the repository.
        line: Where it begins.
        kind: What is changed.
        begin: First byte of what is replaced.
        end: Byte after the last of it.
        text: What stands there instead.
    """

    file: str
    line: int
    kind: str
    begin: int
    end: int
    text: str

    def applied_to(self, source: bytes) -> bytes:
        """Return the file as the mutant has it."""
        return source[: self.begin] + self.text.encode() + source[self.end :]

    def diff(self, source: bytes) -> str:
        """Return the lines that are not the same, with - and +."""
        before, after = source.decode().splitlines(), self.applied_to(source).decode().splitlines()
        lines = list(difflib.unified_diff(before, after, n=0, lineterm=""))
        return "\n".join(line for line in lines[2:] if not line.startswith("@@"))


def find_mutants(file: str, source: bytes) -> list[list[Mutant]]:
    """Return all changes at each place of a file, places in their order.

    Args:
        file: The file, relative to the repository.
        source: Its text.
    """
    tree = ast.parse(source)
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(line: int | None, column: int | None) -> int:
        return starts[(line or 0) - 1] + (column or 0)

    places = []
    for part in (part for part in tree.body if not _is_text(part)):
        first = min(node.lineno for node in (part, *getattr(part, "decorator_list", ())))
        begins, ends = place(first, 0), place(part.end_lineno, part.end_col_offset)
        own = source[begins:ends]
        as_it_is = ast.dump(ast.parse(own))
        for node in _formulas(part):
            begin = place(node.lineno, node.col_offset)
            end = place(node.end_lineno, node.end_col_offset)
            texts = [(k, _text(new)) for k, new in CHANGES.get(type(node), _none)(node)]
            places.append(
                [
                    Mutant(file, node.lineno, kind, begin, end, text)
                    for kind, text in texts
                    if _differs(own, begin - begins, end - begins, text, as_it_is)
                ]
            )
    return [found for found in places if found]


def _differs(source: bytes, begin: int, end: int, text: str, as_it_is: str) -> bool:
    """Return whether another text in a place is Python that means something else."""
    try:
        return ast.dump(ast.parse(source[:begin] + text.encode() + source[end:])) != as_it_is
    except SyntaxError:
        return False


def _text(node: ast.AST) -> str:
    plain = isinstance(node, ast.Constant | ast.Name | ast.Slice | ast.stmt)
    return ast.unparse(node) if plain else f"({ast.unparse(node)})"


def _formulas(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield all nodes under one that are part of a formula, depth first."""
    if isinstance(node, ast.expr | ast.stmt):
        yield node
    for child in _parts(node):
        if not _is_text(child):
            yield from _formulas(child)


def _parts(node: ast.AST) -> list[ast.AST]:
    """Return what a node is made of, types and decorators aside."""
    match node:
        case ast.FunctionDef(args=args, body=body):
            return [*args.defaults, *(d for d in args.kw_defaults if d is not None), *body]
        case ast.ClassDef(body=body):
            return list(body)
        case ast.AnnAssign(value=value):
            return [] if value is None else [value]
        case ast.Lambda(body=body):
            return [body]
    return list(ast.iter_child_nodes(node))


def _is_text(node: ast.AST) -> bool:
    """Return whether a node says something instead of computing it."""
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.Import() | ast.ImportFrom():
            return True
        case ast.keyword(arg=arg):
            return arg in PLAIN_KEYWORDS
        case ast.Call(func=function):
            return _name(function) in SPOKEN
        case ast.If(test=test):
            return _name(test) == "TYPE_CHECKING"
    return False


def _name(node: ast.AST) -> str:
    return str(getattr(node, "attr", getattr(node, "id", "")))


def _none(node: ast.AST) -> list[Change]:
    return []


def _of_constant(node: ast.Constant) -> list[Change]:
    value = node.value
    if isinstance(value, bool):
        return [("truth value", ast.Constant(not value))]
    if not isinstance(value, int | float) or 0 < abs(value) < GUARD:
        return []
    near = [value + 1.0, -value, 1.5 * value] if isinstance(value, float) else [value + 1]
    if isinstance(value, int) and value > 0:
        near.append(value - 1)  # an index of the opposite sign is often the same element
    return [("number", _number(other)) for other in near if other != value]


def _number(value: float) -> ast.expr:
    constant = ast.Constant(abs(value))
    return ast.UnaryOp(ast.USub(), constant) if value < 0 else constant


def _of_operation(node: ast.BinOp) -> list[Change]:
    if type(node.op) not in ARITHMETIC:
        return []
    other = ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)
    changes: list[Change] = [("operator", other), ("right side left out", node.left)]
    if isinstance(node.op, ast.Add | ast.Mult | ast.BitAnd | ast.BitOr):
        changes.append(("left side left out", node.right))
    return changes


def _of_sign(node: ast.UnaryOp) -> list[Change]:
    return [("sign left out", node.operand)]


def _of_conditions(node: ast.BoolOp) -> list[Change]:
    other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    fewer: list[Change] = [("condition left out", value) for value in node.values]
    return [("and, or", ast.BoolOp(other, node.values)), *fewer]


def _of_comparison(node: ast.Compare) -> list[Change]:
    """Turn a comparison around, or shift it where it counts: measured values are never equal."""
    changes: list[Change] = []
    counts = any(_is_count(side) for side in (node.left, *node.comparators))
    for at, operator in enumerate(node.ops):
        for instead in COMPARISONS[type(operator)][0 if counts else -1 :]:
            ops = [*node.ops[:at], instead(), *node.ops[at + 1 :]]
            changes.append(("comparison", ast.Compare(node.left, ops, node.comparators)))
    return changes


def _is_count(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    return isinstance(node, ast.Call) and _name(node.func) in ("len", "sum")


def _of_choice(node: ast.IfExp) -> list[Change]:
    return [("choice", node.body), ("choice", node.orelse)]


def _of_slice(node: ast.Slice) -> list[Change]:
    ends = [(None, node.upper), (node.lower, None)]
    return [("slice", ast.Slice(*end, node.step)) for end in ends]


def _of_call(node: ast.Call) -> list[Change]:
    name, changes = _name(node.func), list[Change]()
    if name in INSTEAD:
        other = copy.deepcopy(node)
        if isinstance(other.func, ast.Attribute):
            other.func.attr = INSTEAD[name]
        elif isinstance(other.func, ast.Name):
            other.func.id = INSTEAD[name]
        changes.append(("function", other))
    if name in LEFT_OUT and node.args:
        changes.append(("function left out", node.args[0]))
    if name == "where" and len(node.args) == 3:
        condition, first, second = node.args
        changes.append(("choice", ast.Call(node.func, [condition, second, first], [])))
    return changes


def _of_statement(node: ast.stmt) -> list[Change]:
    """Leave out what changes something that is there anyhow."""
    match node:
        case ast.AugAssign(target=target, op=op, value=value) if type(op) in ARITHMETIC:
            other = ast.AugAssign(target, ARITHMETIC[type(op)](), value)
            return [("statement left out", ast.Pass()), ("operator", other)]
        case ast.Assign(targets=[ast.Subscript()]):
            return [("statement left out", ast.Pass())]
        case ast.Expr(value=ast.Call(func=function)) if _name(function) not in SPOKEN:
            return [("statement left out", ast.Pass())]
    return []


CHANGES: Mapping[type[ast.AST], Callable[..., list[Change]]] = {
    ast.Constant: _of_constant,
    ast.BinOp: _of_operation,
    ast.UnaryOp: _of_sign,
    ast.BoolOp: _of_conditions,
    ast.Compare: _of_comparison,
    ast.IfExp: _of_choice,
    ast.Slice: _of_slice,
    ast.Call: _of_call,
    ast.AugAssign: _of_statement,
    ast.Assign: _of_statement,
    ast.Expr: _of_statement,
}
"""What may be changed at each kind of node."""
