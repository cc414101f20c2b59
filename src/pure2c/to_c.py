"""Pure functions as C that computes the same to the last bit.

It takes what the law is written in: functions on floats, ints, bools and NamedTuples of them or of None, with
`math`, `if`, `for`, `while` and tuples. Signatures have types; those of local names follow from their first
value. Objects of other types may be passed on, and that is all.

Where Python would raise (a division by zero, a power that overflows), the C goes on with some number and sets
`failed_`: what it then returns is void. So it does where it comes to a statement that has no counterpart: the
rest of that block is left out. Hence a function may do in some rare branch what only Python can.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, TypeGuard, get_type_hints

from pure2c.arithmetic import binary, builtin, number
from pure2c.types import (
    MOST,
    PLAIN,
    Many,
    Maybe,
    TranslationError,
    Type,
    Typed,
    are_rows,
    fields_of,
    is_whole,
    plain,
)

_HELPERS = Path(__file__).with_name("helpers.h")
_PLACE = re.compile(r"(\w+|\(\*\w+\))(\.\w+)*")  # C that stands for a variable or a part of one
_LOCAL = "v_"  # before names in C, where more are taken
_COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


class Translator:
    """Collects structures and functions; `text` is all of them in order."""

    def __init__(self) -> None:
        self._structs: dict[Any, str] = {}
        self._functions: dict[Any, str] = {}
        self._by_value: set[Any] = set()
        self._parts: list[str] = []

    def text(self) -> str:
        """The C source."""
        return "\n".join([_HELPERS.read_text(), *self._parts])

    def function(self, f: Callable[..., Any], name: str = "") -> str:
        """Translate a function and all that it calls.

        Args:
            f: the function.
            name: what to call it in C, for a caller in C who gives it records as they are; else it is called
                by its own name with its module's before it, and gets them by reference.

        Raises:
            TranslationError: it does something that is not provided for.
        """
        if f not in self._functions:
            if not isinstance(f, types.FunctionType):
                raise TranslationError(f"{f!r} is no plain function")
            if name:
                self._by_value.add(f)
            by_reference = not name
            name = name or f"{f.__module__.rpartition('.')[2]}_{f.__name__}"
            taken = self._functions.values()
            self._functions[f] = name if name not in taken else f"{name}_{len(taken)}"
            try:
                self._parts.append(_Function(self, f, by_reference).text(self._functions[f]))
            except TranslationError:
                del self._functions[f]
                raise
        return self._functions[f]

    def given(self, f: Callable[..., Any], codes: Sequence[str], types: Sequence[Type]) -> str:
        """Arguments as a function takes them."""
        if f in self._by_value:
            return ", ".join(codes)
        return ", ".join(
            code if t in PLAIN else f"&{code}" if _PLACE.fullmatch(code) else f"({self.type(t)}[1]){{{code}}}"
            for code, t in zip(codes, types, strict=True)
        )

    def constant(self, name: str, value: Any) -> None:
        """Define a constant NamedTuple."""
        self._parts.append(f"static const {self.type(type(value))} {name} = {self.literal(value)};\n")

    def type(self, t: Type) -> str:
        """The C type for a type; defines structures at their first use."""
        if t in PLAIN:
            return PLAIN[t]
        if t not in self._structs:
            if isinstance(t, Many):  # Python's tuple, or a constant of C's own
                members = [("long", "count"), (PLAIN[object], "tuple"), (f"const {self.type(t.of)}", "*at")]
            else:
                members = [(self.type(inner), field) for field, inner in fields_of(t)]
            name = t.__name__ if isinstance(t, type) else type(t).__name__
            if name in ("tuple", *self._structs.values()) or not isinstance(t, type):
                name = f"{name}_{len(self._structs)}"
            self._structs[t] = name
            inside = " ".join(f"{member} {field};" for member, field in members)
            self._parts.append(f"typedef struct {{ {inside} }} {name};\n")
            if isinstance(t, Many):
                self._parts.append(f"static {self.type(t.of)} {self.item(t)}({name} x, long i);\n")
        return self._structs[t]

    def item(self, t: Many) -> str:
        """The C function that gets one of many; whoever knows where they are has to define it."""
        return f"item_{self.type(t)}"

    def many(self) -> list[Many]:
        """All types of tuples of records that have occurred."""
        return [t for t in self._structs if isinstance(t, Many)]

    def literal(self, value: Any, t: Type = None) -> str:
        """A value in C, exact to the last bit; a tuple that is no record needs its type.

        Raises:
            TranslationError: it is none of numbers, or not of that type.
        """
        if isinstance(t, Maybe):
            return "{0}" if value is None else f"{{1, {self.literal(value, t.of)}}}"
        if isinstance(t, Many) and isinstance(value, tuple):
            if not value:
                return "{0}"
            c, listed = self.type(t.of), ", ".join(self.literal(v, t.of) for v in value)
            name = f"many_{len(self._parts)}"
            self._parts.append(f"static const {c} {name}[] = {{{listed}}};\n")
            return f"{{{len(value)}, 0, {name}}}"
        if isinstance(value, tuple):
            members = fields_of(type(value) if hasattr(value, "_fields") else t)
            if len(members) != len(value):
                raise TranslationError(f"{value!r} is not of the type {t!r}")
            return (
                "{" + ", ".join(self.literal(v, of) for (_, of), v in zip(members, value, strict=True)) + "}"
            )
        if t is float and isinstance(value, int):
            value = float(value)  # a float's place may hold an integer
        return number(value)


class _Function:
    """One function on its way into C."""

    def __init__(self, translator: Translator, f: types.FunctionType, by_reference: bool) -> None:
        self._t = translator
        self._f = f
        self._globals = f.__globals__
        hints = get_type_hints(f)
        self._result = plain(hints.pop("return"))
        self._parameters = {name: plain(hint) for name, hint in hints.items()}
        self._referred = {n for n, t in self._parameters.items() if by_reference and t not in PLAIN}
        self._places: dict[str, str] = {}  # of what is looked at where the caller has it
        self._locals: dict[str, Type] = dict(self._parameters)
        self._count = 0
        code = f.__code__
        self._own = {*code.co_varnames, *code.co_cellvars, *code.co_freevars}

    def text(self, name: str) -> str:
        tree = ast.parse(textwrap.dedent(inspect.getsource(self._f))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        changed = {n.id for n in ast.walk(tree) if _is_stored(n)}
        self._places = {n: f"(*at_{n}_)" for n in self._referred - changed}
        body = self._block(tree.body, 1)
        c = self._t.type
        parameters = ", ".join(
            f"const {c(t)} *at_{n}_" if n in self._referred else f"{c(t)} {_LOCAL}{n}"
            for n, t in self._parameters.items()
        )
        declared = "".join(
            f"  {c(t)} {_LOCAL}{n}{f' = *at_{n}_' if n in self._referred else ''};\n"
            for n, t in self._locals.items()
            if n not in self._places and (n in self._referred or n not in self._parameters)
        )
        return f"static {c(self._result)} {name}({parameters}) {{\n{declared}{body}}}\n"

    def _fail(self, node: ast.AST) -> TranslationError:
        where = f"{self._f.__module__}.{self._f.__name__}"
        return TranslationError(f"{where}: no counterpart in C for {ast.unparse(node)!r}")

    def _block(self, statements: Sequence[ast.stmt], depth: int) -> str:
        text = ""
        for i, s in enumerate(statements):
            known = dict(self._locals)
            try:
                text += self._statement(s, depth)
            except TranslationError:
                self._locals = known
                before = (inner for done in statements[:i] for inner in ast.walk(done))
                if depth == 1 and not any(isinstance(inner, ast.Return) for inner in before):
                    raise  # whatever is asked of it, it comes here
                pad = "  " * depth
                return f"{text}{pad}failed_ = 1;\n{pad}return ({self._t.type(self._result)}){{0}};\n"
        return text

    def _statement(self, s: ast.stmt, depth: int) -> str:
        pad = "  " * depth
        match s:
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                return ""
            case ast.Assert(test=test):
                return f"{pad}if (!{self._truth(test)}) failed_ = 1;\n"
            case ast.Return(value=ast.expr() as value):
                return f"{pad}return {self._as(value, self._result)};\n"
            case ast.Assign(targets=targets, value=value):
                if len(targets) > 1 and self._constant(value) is None:
                    raise self._fail(s)  # it would be evaluated for each
                return "".join(self._assign(target, value, pad) for target in targets)
            case ast.AnnAssign(
                target=ast.Name(id=name) as target, annotation=hint, value=ast.expr() as value
            ):
                self._locals.setdefault(name, self._hinted(hint))
                return self._assign(target, value, pad)
            case ast.AugAssign(target=ast.Name(id=name) as target, op=op, value=value):
                combined = ast.BinOp(ast.Name(name, ast.Load()), op, value)
                return self._assign(target, combined, pad)
            case ast.If(test=test, body=body, orelse=orelse):
                text = f"{pad}if ({self._truth(test)}) {{\n{self._block(body, depth + 1)}{pad}}}"
                return text + (f" else {{\n{self._block(orelse, depth + 1)}{pad}}}\n" if orelse else "\n")
            case ast.While(test=test, body=body, orelse=[]):
                head = f"{pad}while (!failed_ && {self._truth(test)}) {{\n"
                return f"{head}{self._block(body, depth + 1)}{pad}}}\n"
            case ast.For(orelse=[]):
                return self._for(s, depth)
            case ast.Break() | ast.Continue():
                return f"{pad}{ast.unparse(s)};\n"
        raise self._fail(s)

    def _for(self, s: ast.For, depth: int) -> str:
        pad, i = "  " * depth, self._new("i")
        rows = self._rows(s.iter)
        if isinstance(s.target, ast.Tuple) and isinstance(rows, ast.Tuple):
            if any(isinstance(inner, (ast.Break, ast.Continue)) for inner in ast.walk(s)):
                raise self._fail(s)
            # each round may have its own types
            rounds = (f"{self._assign(s.target, e, pad)}{self._block(s.body, depth)}" for e in rows.elts)
            return "".join(rounds)
        if not isinstance(s.target, ast.Name):
            raise self._fail(s.target)
        changed = {n.id for inner in s.body for n in ast.walk(inner) if _is_stored(n)}
        if any(isinstance(n, ast.Name) and n.id in changed for n in ast.walk(s.iter)):
            raise self._fail(s.iter)  # Python looks at it once, before the first round
        match s.iter:
            case ast.Call(func=ast.Name(id="range"), args=[end]):
                head = f"{pad}for (long {i} = 0; {i} < {self._as(end, int)} && !failed_; {i}++) {{\n"
                first = self._set(s.target.id, Typed(i, int), pad + "  ")
            case ast.Subscript(value=value, slice=ast.Slice(lower=None, upper=upper, step=None)) if (
                upper is None or ast.unparse(upper) == "-1"
            ):
                whole, less = self._many(value), " - 1" if upper else ""
                head = f"{pad}for (long {i} = 0; {i} < {whole.code}.count{less} && !failed_; {i}++) {{\n"
                first = self._set(s.target.id, self._item(whole, i), pad + "  ")
            case ast.Tuple(elts=elements):
                values = self._new("values")
                listed = ", ".join(self._as(e, float) for e in elements)
                head = f"{pad}const double {values}[] = {{{listed}}};\n"
                head += f"{pad}for (long {i} = 0; {i} < {len(elements)}; {i}++) {{\n"
                first = self._set(s.target.id, Typed(f"{values}[{i}]", float), pad + "  ")
            case _:
                raise self._fail(s.iter)
        return f"{head}{first}{self._block(s.body, depth + 1)}{pad}}}\n"

    def _rows(self, node: ast.expr) -> ast.expr:
        """A module's tuple of tuples of numbers as if it were written out."""
        found = self._globals.get(node.id) if isinstance(node, ast.Name) and node.id not in self._own else 0
        return ast.parse(repr(found), mode="eval").body if are_rows(found) else node

    def _many(self, node: ast.expr) -> Typed:
        found = self._expr(node)
        if not isinstance(found.type, Many):
            raise self._fail(node)
        return found

    def _item(self, whole: Typed, place: str) -> Typed:
        return Typed(f"{self._t.item(whole.type)}({whole.code}, {place})", whole.type.of)

    def _assign(self, target: ast.expr, value: ast.expr, pad: str) -> str:
        found = self._expr(value)
        if isinstance(target, ast.Name):
            return self._set(target.id, found, pad)
        if not isinstance(target, ast.Tuple):
            raise self._fail(target)
        parts = fields_of(found.type)
        if len(parts) != len(target.elts):
            raise self._fail(target)
        whole = self._new("whole")  # everything is evaluated before anything is assigned
        text = f"{pad}const {self._t.type(found.type)} {whole} = {found.code};\n"
        for element, (field, inner) in zip(target.elts, parts, strict=True):
            if not isinstance(element, ast.Name):
                raise self._fail(target)
            text += self._set(element.id, Typed(f"{whole}.{field}", inner), pad)
        return text

    def _set(self, name: str, value: Typed, pad: str) -> str:
        if name == "_":
            return ""
        known = self._locals.setdefault(name, value.type)
        code = value.code
        if known == value.type or (known is float and value.type is int):
            pass
        elif isinstance(known, Maybe):
            code = self._fitted(value, known)
        else:
            raise TranslationError(f"{self._f.__name__}: {name} changes its type")
        return f"{pad}{_LOCAL}{name} = {code};\n"

    def _fitted(self, value: Typed, t: Type) -> str:
        """A value where a type is expected that may be None or not."""
        if value.type == t or {value.type, t} <= {int, float}:
            return value.code
        if value.type == Maybe(t):
            return self._some(value).code
        if isinstance(t, Maybe) and value.type is NoneType:
            return f"(({self._t.type(t)}){{0}})"
        if t == Maybe(value.type):
            return f"(({self._t.type(t)}){{1, {value.code}}})"
        raise TranslationError(f"{self._f.__name__}: {value.code} is not of the type that is expected")

    def _some(self, value: Typed) -> Typed:
        """What a value is that is not None."""
        if not isinstance(value.type, Maybe):
            return value
        held = self._new("held")
        code = f"({{ const {self._t.type(value.type)} {held} = {value.code};"
        return Typed(f"{code} failed_ |= !{held}.some; {held}.value; }})", value.type.of)

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
        """An expression where a type is expected: tuples take theirs from it."""
        if isinstance(node, ast.Tuple) and isinstance(t, tuple) and len(t) == len(node.elts):
            return self._struct(
                t, [self._as(e, inner) for e, (_, inner) in zip(node.elts, fields_of(t), strict=True)]
            )
        if isinstance(node, ast.IfExp) and t not in (float, int):
            test = self._truth(node.test)
            return f"({test} ? {self._as(node.body, t)} : {self._as(node.orelse, t)})"
        if isinstance(node, ast.Name) and node.id not in self._locals:
            value = self._globals.get(node.id)
            if isinstance(value, tuple) and not hasattr(value, "_fields"):
                return f"(({self._t.type(t)}){self._t.literal(value, t)})"
        return self._fitted(self._expr(node), t)

    def _struct(self, t: Type, members: Sequence[str]) -> str:
        return f"(({self._t.type(t)}){{{', '.join(members)}}})"

    def _expr(self, node: ast.expr) -> Typed:
        if isinstance(node, ast.Constant) and node.value is None:
            return Typed("0", NoneType)
        if (
            isinstance(node, ast.Name)
            and node.id not in self._locals
            and hasattr(value := self._globals.get(node.id), "_fields")
            and isinstance(value, tuple)
        ):
            of = type(value)
            return Typed(f"(({self._t.type(of)}){self._t.literal(value)})", of)
        constant = self._constant(node)
        if constant is not None:
            return Typed(self._t.literal(constant), float if isinstance(constant, float) else int)
        match node:
            case ast.Name(id=name) if name in self._locals:
                return Typed(self._places.get(name, f"{_LOCAL}{name}"), self._locals[name])
            case ast.Attribute(value=value, attr=attr):
                whole = self._some(self._expr(value))
                named = dict(fields_of(whole.type))
                if attr not in named:
                    raise self._fail(node)
                return Typed(f"{whole.code}.{attr}", named[attr])
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
                return Typed(f"{whole.code}.{field}", inner_type)
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
            case ast.IfExp(test=test, body=body, orelse=orelse):
                a, b = self._expr(body), self._expr(orelse)
                if a.type != b.type and {a.type, b.type} != {int, float}:
                    raise self._fail(node)
                t = a.type if a.type == b.type else float
                return Typed(f"({self._truth(test)} ? {a.code} : {b.code})", t)
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
        if any(isinstance(n, ast.Name) and n.id in self._own for n in ast.walk(func)):
            raise self._fail(node)
        if any(k.arg is None for k in keywords):
            raise self._fail(node)
        try:
            called = eval(compile(ast.Expression(func), "<function>", "eval"), self._globals)
        except Exception:
            raise self._fail(node) from None
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
        is_record = isinstance(called, type) and hasattr(called, "_fields")
        wanted = inspect.signature(called).parameters
        hints = get_type_hints(called)
        given = dict(zip(wanted, args, strict=False)) | {k.arg: k.value for k in keywords if k.arg}
        codes = []
        for name, parameter in wanted.items():
            if name in given:
                codes.append(self._as(given[name], plain(hints[name])))
            elif parameter.default is not parameter.empty:
                codes.append(self._t.literal(parameter.default, plain(hints[name])))
            else:
                raise self._fail(node)
        if is_record:
            return Typed(self._struct(called, codes), called)
        made = self._t.function(called)
        passed = self._t.given(called, codes, [plain(hints[n]) for n in wanted])
        return Typed(f"{made}({passed})", plain(hints["return"]))

    def _replaced(self, whole: Typed, keywords: list[ast.keyword], node: ast.expr) -> Typed:
        """A record with some fields changed."""
        if not hasattr(whole.type, "_fields") or isinstance(whole.type, (Maybe, Many)):
            raise self._fail(node)
        fields, changed = fields_of(whole.type), {k.arg: k.value for k in keywords}
        if not set(changed) <= {name for name, _ in fields}:
            raise self._fail(node)
        members = [
            self._as(changed[name], t) if name in changed else f"{whole.code}.{name}" for name, t in fields
        ]
        return Typed(self._struct(whole.type, members), whole.type)


def _is_stored(node: ast.AST) -> TypeGuard[ast.Name]:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
