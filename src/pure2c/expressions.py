"""Expressions of Python in C.

A record that stays as it is has a place in C, and is referred to there; what is made anew gets a place where
it needs one. So nothing is copied that is only looked at.
"""

from __future__ import annotations

import ast
import inspect
import re
import types
from collections.abc import Sequence
from types import NoneType
from typing import TYPE_CHECKING, Any, get_type_hints

from pure2c.arithmetic import binary, builtin
from pure2c.types import (
    LASTING,
    MOST,
    PASSING,
    PLAIN,
    VALUE,
    Many,
    Maybe,
    TranslationError,
    Type,
    Typed,
    fields_of,
    is_whole,
    plain,
)

if TYPE_CHECKING:
    from pure2c.to_c import Translator

LOCAL = "v_"  # before names in C, where more are taken
_LITERAL = re.compile(r"\(\(\w+\)(\{.*\})\)", re.DOTALL)
_COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


class Expressions:
    """The expressions of one function."""

    def __init__(self, translator: Translator, f: types.FunctionType) -> None:
        self._t = translator
        self._f = f
        self._globals = f.__globals__
        hints = get_type_hints(f)
        self._result = plain(hints.pop("return"))
        self._parameters = {name: plain(hint) for name, hint in hints.items()}
        self._locals: dict[str, Type] = dict(self._parameters)
        self._copied: set[str] = set()  # names that are records of their own, not places of others
        self._buffers: list[tuple[str, str]] = []
        self._count = 0
        code = f.__code__
        self._own = {*code.co_varnames, *code.co_cellvars, *code.co_freevars}

    def _local(self, name: str) -> Typed:
        """What a local name stands for."""
        t = self._locals[name]
        if t in PLAIN:
            return Typed(f"{LOCAL}{name}", t)
        if name in self._copied:
            return Typed(f"{LOCAL}{name}", t, PASSING)
        return Typed(f"(*{self._pointer(name)})", t, LASTING)

    def _pointer(self, name: str) -> str:
        """The variable that tells where a local record is."""
        return f"at_{name}_" if name in self._parameters else f"{LOCAL}{name}"

    def _fail(self, node: ast.AST) -> TranslationError:
        where = f"{self._f.__module__}.{self._f.__name__}"
        return TranslationError(f"{where}: no counterpart in C for {ast.unparse(node)!r}")

    def _many(self, node: ast.expr) -> Typed:
        found = self._expr(node)
        if not isinstance(found.type, Many):
            raise self._fail(node)
        return found

    def _item(self, whole: Typed, place: str) -> Typed:
        return Typed(f"{self._t.item(whole.type)}({whole.code}, {place})", whole.type.of)

    def _fitted(self, value: Typed, t: Type) -> Typed:
        """A value where a type is expected that may be None or not."""
        if value.type == t or {value.type, t} <= {int, float}:
            return value
        if value.type == Maybe(t):
            return self._some(value)
        if isinstance(t, Maybe) and value.type is NoneType:
            return self._t.kept(None, t)
        if t == Maybe(value.type):
            return Typed(f"(({self._t.type(t)}){{1, {_inner(value.code)}}})", t)
        raise TranslationError(f"{self._f.__name__}: {value.code} is not of the type that is expected")

    def _some(self, value: Typed) -> Typed:
        """What a value is that is not None."""
        if not isinstance(value.type, Maybe):
            return value
        held, c = self._new("held"), self._t.type(value.type)
        code = f"(*({{ const {c} *{held} = {self._at(value)}; failed_ |= !{held}->some; &{held}->value; }}))"
        return Typed(code, value.type.of, value.place or LASTING)

    def _at(self, value: Typed) -> str:
        """The address of a value; one that has no place gets one."""
        if value.place == VALUE:
            buffer = self._buffer(value.type)
            return f"({buffer} = {value.code}, &{buffer})"
        whole = value.code.startswith("(*") and value.code.endswith(")")
        return value.code[2:-1] if whole else f"&{value.code}"

    def _buffer(self, t: Type) -> str:
        """A variable of the function that nothing else is put into."""
        name = self._new("b")
        self._buffers.append((name, self._t.type(t)))
        return name

    def _hinted(self, hint: ast.expr) -> Type:
        """The type of an annotation within a function."""
        try:
            return plain(eval(ast.unparse(hint), self._globals))
        except Exception:
            raise self._fail(hint) from None

    def _new(self, stem: str) -> str:
        self._count += 1
        return f"{stem}_{self._count}"

    def _as(self, node: ast.expr, t: Type) -> str:
        """An expression in C where a type is expected."""
        return self._fit(node, t).code

    def _fit(self, node: ast.expr, t: Type) -> Typed:
        """An expression where a type is expected: tuples take theirs from it."""
        if isinstance(node, ast.Tuple) and isinstance(t, tuple) and len(t) == len(node.elts):
            inside = zip(node.elts, fields_of(t), strict=True)
            return Typed(self._struct(t, [self._as(one, inner) for one, (_, inner) in inside]), t)
        if isinstance(node, ast.IfExp) and t not in PLAIN:
            return self._either(node, self._fit(node.body, t), self._fit(node.orelse, t), t)
        if isinstance(node, ast.Name) and node.id not in self._locals:
            value = self._globals.get(node.id)
            if isinstance(value, tuple) and not hasattr(value, "_fields"):
                return self._t.kept(value, t)
        return self._fitted(self._expr(node), t)

    def _either(self, node: ast.IfExp, a: Typed, b: Typed, t: Type) -> Typed:
        """One of two."""
        test = self._truth(node.test)
        if t in PLAIN or VALUE in (a.place, b.place):
            return Typed(f"({test} ? {a.code} : {b.code})", t)
        return Typed(f"(*({test} ? {self._at(a)} : {self._at(b)}))", t, min(a.place, b.place))

    def _struct(self, t: Type, members: Sequence[str]) -> str:
        return f"(({self._t.type(t)}){{{', '.join(map(_inner, members))}}})"

    def _expr(self, node: ast.expr) -> Typed:
        if isinstance(node, ast.Constant) and node.value is None:
            return Typed("0", NoneType)
        if (
            isinstance(node, ast.Name)
            and node.id not in self._locals
            and hasattr(value := self._globals.get(node.id), "_fields")
            and isinstance(value, tuple)
        ):
            return self._t.kept(value, type(value))
        constant = self._constant(node)
        if constant is not None:
            return Typed(self._t.literal(constant), float if isinstance(constant, float) else int)
        match node:
            case ast.Name(id=name) if name in self._locals:
                return self._local(name)
            case ast.Attribute(value=value, attr=attr):
                whole = self._some(self._expr(value))
                named = dict(fields_of(whole.type))
                if attr not in named:
                    raise self._fail(node)
                return Typed(f"{whole.code}.{attr}", named[attr], whole.place)
            case ast.Subscript(value=ast.Name(id=name), slice=key) if isinstance(
                table := self._globals.get(name), dict
            ):
                return self._looked_up(table, self._expr(key))
            case ast.Subscript(value=value, slice=key) if isinstance(index := self._constant(key), int):
                whole = self._expr(value)
                if isinstance(whole.type, Many):
                    return self._item(whole, str(index) if index >= 0 else f"{whole.code}.count - {-index}")
                fields = fields_of(whole.type)
                if not 0 <= index < len(fields):
                    raise self._fail(node)
                field, inner_type = fields[index]
                return Typed(f"{whole.code}.{field}", inner_type, whole.place)
            case ast.Subscript(value=value, slice=ast.Name() | ast.Attribute() | ast.BinOp() as key):
                whole, at = self._many(value), self._expr(key)
                if at.type is not int:
                    raise self._fail(node)
                return self._item(whole, at.code)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as op, operand=operand):
                inner = self._number(operand)
                if isinstance(op, ast.USub) and inner.type is int:
                    return Typed(f"minus_(0, {inner.code})", int)
                return Typed(f"({'-' if isinstance(op, ast.USub) else '+'}{inner.code})", inner.type)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return Typed(f"(!{self._truth(operand)})", int)
            case ast.BinOp(left=left, op=ast.BitAnd() | ast.BitOr() as op, right=right) if (
                masked := self._with_mask(left, op, right)
            ) is not None:
                return masked
            case ast.BinOp(left=left, op=op, right=right):
                return self._done(binary(self._number(left), op, self._number(right)), node)
            case ast.BoolOp(op=op, values=values):
                return self._choice(op, values, node)
            case ast.Compare(left=left, ops=ops, comparators=comparators):
                return self._compare([left, *comparators], ops, node)
            case ast.IfExp(body=body, orelse=orelse) as whole_node:
                a, b = self._expr(body), self._expr(orelse)
                if a.type != b.type and {a.type, b.type} != {int, float}:
                    raise self._fail(node)
                return self._either(whole_node, a, b, a.type if a.type == b.type else float)
            case ast.Tuple(elts=elements):
                found = [self._expr(e) for e in elements]
                t = tuple(e.type for e in found)
                return Typed(self._struct(t, [e.code for e in found]), t)
            case ast.Call(func=func, args=args, keywords=keywords):
                return self._call(func, args, keywords, node)
        raise self._fail(node)

    def _truth(self, node: ast.expr) -> str:
        """A number that is asked whether it is zero."""
        if isinstance(node, ast.BoolOp):
            sign = " && " if isinstance(node.op, ast.And) else " || "
            return "(" + sign.join(self._truth(v) for v in node.values) + ")"
        return self._number(node).code

    def _choice(self, op: ast.boolop, values: Sequence[ast.expr], node: ast.expr) -> Typed:
        """The first of some numbers that is zero, or that is not; else the last."""
        *first, chosen = (self._number(v) for v in values)
        for one in reversed(first):
            if one.type is not chosen.type:
                raise self._fail(node)
            name, c = self._new("one"), self._t.type(one.type)
            pick = f"{name} : {chosen.code}" if isinstance(op, ast.Or) else f"{chosen.code} : {name}"
            chosen = Typed(f"({{ const {c} {name} = {one.code}; {name} ? {pick}; }})", one.type)
        return chosen

    def _with_mask(self, left: ast.expr, op: ast.operator, right: ast.expr) -> Typed | None:
        """An integer's bits and those of a constant that C has not all of; None where it has.

        What C holds is not negative, or is left to Python: it has none of the bits that are cut off.
        """
        for node, other in ((right, left), (left, right)):
            mask = self._constant(node)
            if isinstance(mask, int) and not is_whole(mask):
                if isinstance(op, ast.BitOr):
                    return Typed("((void)(failed_ = 1), 0L)", int)
                return Typed(f"masked_({self._number(other).code}, {mask & MOST}L)", int)
            table = self._table(node)
            if table is not None and not all(is_whole(value) for value in table.values()):
                cut = {key: value & MOST for key, value in table.items()}
                if isinstance(op, ast.BitOr) or not isinstance(node, ast.Subscript):
                    raise self._fail(node)
                code = self._looked_up(cut, self._expr(node.slice)).code
                return Typed(f"masked_({self._number(other).code}, {code})", int)
        return None

    def _table(self, node: ast.expr) -> dict[Any, int] | None:
        """The constant dictionary of integers that an element is asked of."""
        if not isinstance(node, ast.Subscript) or not isinstance(node.value, ast.Name):
            return None
        found = self._globals.get(node.value.id)
        whole = isinstance(found, dict) and all(isinstance(value, int) for value in found.values())
        return found if whole else None

    def _done(self, found: Typed | None, node: ast.expr) -> Typed:
        """What has been found; it has to be something."""
        if found is None:
            raise self._fail(node)
        return found

    def _number(self, node: ast.expr) -> Typed:
        found = self._expr(node)
        if found.type not in (int, float):
            raise self._fail(node)
        return found

    def _constant(self, node: ast.expr) -> int | float | None:
        """The number that an expression without local names stands for."""
        inside = list(ast.walk(node))
        if any(isinstance(n, ast.Call) or (isinstance(n, ast.Name) and n.id in self._locals) for n in inside):
            return None
        if not any(isinstance(n, (ast.Name, ast.Constant)) for n in inside) or isinstance(node, ast.Tuple):
            return None
        if any(isinstance(n, ast.Name) and n.id in self._own for n in inside):
            raise self._fail(node)  # a local one that has no value here
        try:
            value = eval(compile(ast.Expression(node), "<constant>", "eval"), self._globals)
        except Exception:
            raise self._fail(node) from None
        return value if isinstance(value, (int, float)) else None

    def _compare(self, terms: Sequence[ast.expr], ops: Sequence[ast.cmpop], node: ast.expr) -> Typed:
        if isinstance(ops[0], (ast.Is, ast.IsNot)):
            whole = self._expr(terms[0])
            if len(ops) > 1 or not isinstance(whole.type, Maybe) or self._expr(terms[1]).type is not NoneType:
                raise self._fail(node)
            return Typed(f"({'!' if isinstance(ops[0], ast.Is) else ''}{whole.code}.some)", int)
        parts = []
        for left, op, right in zip(terms, ops, terms[1:], strict=False):
            a = self._number(left).code
            if isinstance(op, (ast.In, ast.NotIn)):
                among = " || ".join(f"{a} == {code}" for code in self._members(right))
                parts.append(f"{'' if isinstance(op, ast.In) else '!'}({among})")
            elif type(op) in _COMPARE:
                parts.append(f"{a} {_COMPARE[type(op)]} {self._number(right).code}")
            else:
                raise self._fail(node)
        return Typed("(" + " && ".join(parts) + ")", int)

    def _looked_up(self, table: dict[Any, Any], key: Typed) -> Typed:
        """An element of a constant dictionary of numbers."""
        code = "(failed_ = 1, 0)"
        for known, value in table.items():
            code = f"({key.code} == {self._t.literal(known)} ? {self._t.literal(value)} : {code})"
        return Typed(code, int if all(isinstance(value, int) for value in table.values()) else float)

    def _members(self, node: ast.expr) -> list[str]:
        """The elements of a tuple, written out or a constant of the module."""
        if isinstance(node, ast.Tuple):
            return [self._number(e).code for e in node.elts]
        if isinstance(node, ast.Name) and isinstance(self._globals.get(node.id), (tuple, dict)):
            return [self._t.literal(value) for value in self._globals[node.id]]
        raise self._fail(node)

    def _call(
        self, func: ast.expr, args: list[ast.expr], keywords: list[ast.keyword], node: ast.expr
    ) -> Typed:
        if isinstance(func, ast.Attribute) and func.attr == "_replace":
            return self._replaced(self._expr(func.value), keywords, node)
        called = self._function_of(func, keywords, node)
        if called is not len and (
            isinstance(called, types.BuiltinFunctionType) or called in (float, int, bool)
        ):
            if keywords or not args:
                raise self._fail(node)
            return self._done(builtin(called, [self._number(a) for a in args]), node)
        if called is len and len(args) == 1:
            return Typed(f"{self._many(args[0]).code}.count", int)
        if not (isinstance(called, types.FunctionType) or hasattr(called, "_fields")):
            raise self._fail(node)
        given = self._arguments(called, args, keywords, node)
        if isinstance(called, type):
            return Typed(self._struct(called, [one.code for _, one in given]), called)
        return self._called(called, [one for _, one in given])

    def _arguments(
        self, called: Any, args: list[ast.expr], keywords: list[ast.keyword], node: ast.expr
    ) -> list[tuple[str, Typed]]:
        """What is given to a function or class, by the parameters' names in their order."""
        return [
            (name, self._fit(one, t) if isinstance(one, ast.expr) else self._t.kept(one, t))
            for name, one, t in self._given(called, args, keywords, node)
        ]

    def _given(
        self, called: Any, args: list[ast.expr], keywords: list[ast.keyword], node: ast.expr
    ) -> list[tuple[str, Any, Type]]:
        """Parameters, what is given for each, an expression or a default, and their types."""
        wanted, hints = inspect.signature(called).parameters, get_type_hints(called)
        given: dict[str, Any] = {name: parameter.default for name, parameter in wanted.items()}
        given |= dict(zip(wanted, args, strict=False)) | {k.arg: k.value for k in keywords if k.arg}
        if any(one is inspect.Parameter.empty for one in given.values()):
            raise self._fail(node)
        return [(name, given[name], plain(hints[name])) for name in wanted]

    def _called(self, called: Any, given: Sequence[Typed], into: str = "") -> Typed:
        """A call; `into` is where its record goes, unless the function lends what it was given."""
        name, t = self._t.function(called), plain(get_type_hints(called)["return"])
        passed = [one.code if one.type in PLAIN else self._at(one) for one in given]
        if t in PLAIN:
            return Typed(f"{name}({', '.join(passed)})", t)
        code = f"(*{name}({', '.join((into or f'&{self._buffer(t)}', *passed))}))"
        changing = any(one.place == PASSING and one.type not in PLAIN for one in given)
        return Typed(code, t, PASSING if changing and called in self._t.lending else LASTING)

    def _function_of(self, func: ast.expr, keywords: list[ast.keyword], node: ast.expr) -> Any:
        """What is called."""
        own = any(isinstance(n, ast.Name) and n.id in self._own for n in ast.walk(func))
        if own or any(k.arg is None for k in keywords):
            raise self._fail(node)
        try:
            return eval(compile(ast.Expression(func), "<function>", "eval"), self._globals)
        except Exception:
            raise self._fail(node) from None

    def _replaced(self, whole: Typed, keywords: list[ast.keyword], node: ast.expr) -> Typed:
        """A record with some fields changed."""
        if not hasattr(whole.type, "_fields") or isinstance(whole.type, (Maybe, Many)):
            raise self._fail(node)
        fields, changed = fields_of(whole.type), {k.arg: k.value for k in keywords}
        if not set(changed) <= {name for name, _ in fields}:
            raise self._fail(node)
        held = self._new("held")
        members = [self._as(changed[name], t) if name in changed else f"{held}->{name}" for name, t in fields]
        c, made = self._t.type(whole.type), self._struct(whole.type, members)
        return Typed(f"({{ const {c} *{held} = {self._at(whole)}; {made}; }})", whole.type)


def _inner(code: str) -> str:
    """A member of a record that is written out: one that is itself written out needs no type."""
    found = _LITERAL.fullmatch(code)
    return found[1] if found and _closes_last(code) else code


def _closes_last(code: str) -> bool:
    """Whether the parenthesis that comes first is closed by the last one."""
    depth = 0
    for i, c in enumerate(code):
        depth += (c == "(") - (c == ")")
        if depth == 0:
            return i == len(code) - 1
    return False
