"""Bounds of what a xacro file may ask for in time and memory: a few words can ask for any amount of both.

Operators, calls and loops of expressions are replaced by ones that count, and that refuse large operands before they
work on them.
"""

from __future__ import annotations

import ast
import operator
import re
import uuid
from collections.abc import Iterable, Iterator

from sonar_gl.core.errors import Error

# elements, texts, calls and turns of loops, which take half a minute
MAX_STEPS = 200_000
MAX_CHARACTERS = 20_000_000  # of all texts together
MAX_LENGTH = 10_000  # of a text or list that an expression computes
MAX_BITS = 4096  # of a whole number; the largest float has 1024
OPERATORS = {ast.Add: operator.add, ast.Mult: operator.mul, ast.Mod: operator.mod}
OPERATORS |= {ast.Pow: operator.pow, ast.LShift: operator.lshift}
WIDE = re.compile(r"\d{4}|\*")  # a width or precision in a text that % formats
# Methods whose result is as long as a number says, and functions whose work grows without bound with a number.
REFUSED_METHODS = "center|expandtabs|ljust|rjust|to_bytes|zfill"
GROWING = "comb", "factorial", "perm", "round"


class Bounds:
    """Counts what the expansion of a file takes.

    Attributes
    ----------
    names : functions of the expressions that `rewrite` returns, by names that no file can know
    """

    def __init__(self):
        self._steps = self._characters = 0
        secret = uuid.uuid4().hex
        self._operate_name, self._call_name, self._loop_name = (
            f"{name}_{secret}" for name in ("operate", "call", "loop")
        )
        self.names = {
            self._operate_name: self._operate,
            self._call_name: self._call,
            self._loop_name: self._loop,
        }

    def step(self) -> None:
        """Count one step; raise an Error if there were too many."""
        self._steps += 1
        if self._steps > MAX_STEPS:
            raise Error(f"a xacro file must expand in at most {MAX_STEPS} steps (this one takes more)")

    def text(self, value) -> None:
        """Count a step, and the characters of a text; raise an Error if there were too many."""
        self.step()
        for one in _leaves(value):  # of a list, which becomes a text: lists may hold one another many times
            self._characters += len(one) if isinstance(one, (str, bytes)) else 20
            if self._characters > MAX_CHARACTERS:
                break
        if self._characters > MAX_CHARACTERS:
            most = MAX_CHARACTERS // 1_000_000
            raise Error(f"a xacro file must expand to at most {most} million characters (got more)")

    def rewrite(self, tree: ast.Expression) -> str:
        """Return the text of an expression whose operators, calls and loops are counted."""
        return ast.unparse(ast.fix_missing_locations(_Rewriter(self).visit(tree)))

    def operation(self, node: ast.BinOp) -> ast.AST:
        """Return the call that stands for an operator."""
        name = ast.Constant(type(node.op).__name__)
        return _call_of(self._operate_name, [name, node.left, node.right])

    def call(self, node: ast.Call) -> ast.AST:
        """Return the call that stands for a call."""
        return _call_of(self._call_name, [node.func, *node.args], node.keywords)

    def loop(self, node: ast.AST) -> ast.AST:
        """Return the call that stands for what a loop goes through."""
        return _call_of(self._loop_name, [node])

    def _operate(self, name: str, left, right):
        kind = getattr(ast, name)
        whole = isinstance(left, int) and isinstance(right, int)
        if kind is ast.Mod and isinstance(left, (str, bytes)):
            text = left if isinstance(left, str) else left.decode("latin-1")
            _check(not WIDE.search(text), "a text that % formats must have widths below 1000, and no *")
        elif kind is ast.Pow and whole and right > 0:
            _check_bits(max(left.bit_length() - 1, abs(left) > 1) * right)
        elif kind is ast.LShift and whole:
            _check_bits(left.bit_length() + right)
        elif kind is ast.Mult:
            for one, times in ((left, right), (right, left)):
                if hasattr(one, "__len__") and isinstance(times, int):
                    _check_length(len(one) * times)
        return _checked(OPERATORS[kind](left, right))

    def _call(self, function, *values, **named):
        self.step()
        if getattr(function, "__name__", "") in GROWING:
            for value in (*values, *named.values()):
                _check(
                    not isinstance(value, int) or abs(value) <= 1000, f"{function.__name__} of large numbers"
                )
        if function is map and values:
            function, *iterables = values
            return [self._call(function, *row) for row in zip(*iterables)]  # noqa: B905
        return _checked(function(*values, **named))

    def _loop(self, values: Iterable) -> Iterator:
        for value in values:
            self.step()
            yield value


class _Rewriter(ast.NodeTransformer):
    def __init__(self, bounds: Bounds):
        self._bounds = bounds

    def visit_BinOp(self, node):
        self.generic_visit(node)
        return self._bounds.operation(node) if type(node.op) in OPERATORS else node

    def visit_Call(self, node):
        self.generic_visit(node)
        return self._bounds.call(node)

    def visit_comprehension(self, node):
        self.generic_visit(node)
        node.iter = self._bounds.loop(node.iter)
        return node


def _leaves(value) -> Iterator:
    """Yield all that a value consists of, itself included, as often as it stands in its text."""
    waiting = [value]
    while waiting:
        one = waiting.pop()
        yield one
        if isinstance(one, dict):
            waiting += [*one.keys(), *one.values()]
        elif isinstance(one, (list, tuple, set, frozenset)):
            waiting += one


def _call_of(name: str, values: list, named: list | None = None) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), values, named or [])


def _check(is_right: bool, text: str) -> None:
    if not is_right:
        raise Error(f"expressions must be simple ones (refused: {text})")


def _check_length(length: int) -> None:
    _check(length <= MAX_LENGTH, f"a text or list of more than {MAX_LENGTH}")


def _check_bits(n_bits: int) -> None:
    _check(n_bits <= MAX_BITS, f"a whole number of more than {MAX_BITS} bits")


def _checked(value):
    """Return a value; raise an Error if it is too large for further work."""
    if isinstance(value, int):
        _check_bits(value.bit_length())
    elif isinstance(value, range):
        _check(_length_of(value) <= MAX_LENGTH, f"a range of more than {MAX_LENGTH}")
    elif hasattr(value, "__len__"):
        _check_length(len(value))
    return value


def _length_of(value: range) -> int:
    """Return the length of a range, which `len` refuses beyond 2⁶³."""
    return max(0, -((value.start - value.stop) // value.step))
