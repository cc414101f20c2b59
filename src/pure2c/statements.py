"""Statements of Python in C, and a function made of them.

A name of a record is a pointer to where the record is: to give it another name costs nothing. What is made
anew has a variable of its own for each place in the source where that is done, and is written field by field
into it. In a loop the same place comes again, so names that are given there are variables, and copied.
"""

from __future__ import annotations

import ast
import inspect
import linecache
import re
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from tokenize import TokenError
from types import CodeType, FunctionType, NoneType
from typing import TypeGuard

from pure2c.expressions import LOCAL, Expressions
from pure2c.reach import doings
from pure2c.types import (
    LASTING,
    PLAIN,
    VALUE,
    BuildError,
    Maybe,
    TranslationError,
    Type,
    Typed,
    are_numbers,
    are_rows,
    fields_of,
)

_OWN = re.compile(r"\b(?:b|held|whole|part)_\d+\b|\bv_\w+")  # variables of a function
_AT = re.compile(r"\bat_(\w+)_\b")


class Function(Expressions):
    """One function on its way into C."""

    def text(self, name: str) -> str:
        """Its definition.

        Args:
            name: in C.
        """
        tree = _definition(self._f)
        self._changed = {n.id for n in ast.walk(tree) if _is_stored(n)}
        loops = [n for n in ast.walk(tree) if isinstance(n, (ast.For, ast.While))]
        self._copied = {n.id for loop in loops for n in ast.walk(loop) if _is_stored(n)}
        self._homes: dict[int, str] = {}  # by assignment: where in the result its record goes
        body = self._block(tree.body, 1)
        return f"{self.head(name)} {{\n{self._declared()}{body}}}\n"

    def head(self, name: str) -> str:
        """Its declaration; a record that it returns goes where the first argument says, or is lent."""
        c = self._t.type
        parameters = [
            f"{c(t)} {LOCAL}{n}" if t in PLAIN else f"const {c(t)} *at_{n}_"
            for n, t in self._parameters.items()
        ]
        if self._result in PLAIN:
            return f"static inline {c(self._result)} {name}({', '.join(parameters)})"
        into = f"{c(self._result)} *restrict out_"
        return f"static inline const {c(self._result)} *{name}({', '.join((into, *parameters))})"

    def _declared(self) -> str:
        """Its variables."""
        text = "".join(f"  {c} {buffer};\n" for buffer, c in self._buffers)
        for n, t in self._locals.items():
            c = self._t.type(t)
            if t in PLAIN:
                text += "" if n in self._parameters else f"  {c} {LOCAL}{n};\n"
            elif n in self._copied:
                text += f"  {c} {LOCAL}{n}{f' = *at_{n}_' if n in self._parameters else ''};\n"
            elif n not in self._parameters:
                text += f"  const {c} *{LOCAL}{n} = &{self._t.nothing(t)};\n"
        return text

    def _block(self, statements: Sequence[ast.stmt], depth: int) -> str:
        text = ""
        self._settle(statements)
        for i, s in enumerate(statements):
            known = dict(self._locals)
            try:
                text += self._statement(s, depth)
            except TranslationError:
                self._locals = known
                before = (inner for done in statements[:i] for inner in ast.walk(done))
                if depth == 1 and not any(isinstance(inner, ast.Return) for inner in before):
                    raise  # whatever is asked of it, it comes here
                pad, c = "  " * depth, self._t.type(self._result)
                if self._result in PLAIN:
                    return f"{text}{pad}failed_ = 1;\n{pad}return 0;\n"
                return f"{text}{pad}failed_ = 1;\n{pad}*out_ = ({c}){{0}};\n{pad}return out_;\n"
        return text

    def _settle(self, statements: Sequence[ast.stmt]) -> None:
        """What a block returns in the end is made where it is to be returned, if it can be."""
        end = statements[-1]
        if self._result in PLAIN or not isinstance(end, ast.Return):
            return
        parts = {"(*out_)": (end.value, self._result)}
        if isinstance(end.value, ast.Tuple) and isinstance(self._result, tuple):
            inside = zip(end.value.elts, fields_of(self._result), strict=False)
            parts = {f"(*out_).{field}": (one, t) for one, (field, t) in inside}
        named = [one.id for one, _ in parts.values() if isinstance(one, ast.Name)]
        for home, (one, t) in parts.items():
            if (
                not isinstance(one, ast.Name)
                or named.count(one.id) > 1
                or one.id in self._copied
                or t in PLAIN
            ):
                continue
            for s in reversed(statements[:-1]):
                if isinstance(s, (ast.Assign, ast.AnnAssign)) and _is_to(s, one.id):
                    self._homes[id(s)] = home
                if any(isinstance(n, ast.Return) or (_is_stored(n) and n.id == one.id) for n in ast.walk(s)):
                    break

    def _statement(self, s: ast.stmt, depth: int) -> str:
        pad = "  " * depth
        match s:
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                return ""
            case ast.Assert(test=test):
                return f"{pad}if (!{self._truth(test)}) failed_ = 1;\n"
            case ast.Return(value=ast.expr() as value):
                return self._return(value, pad)
            case ast.Assign(targets=targets, value=value):
                if len(targets) > 1 and self._constant(value) is None:
                    raise self._fail(s)  # it would be evaluated for each
                return "".join(self._assign(target, value, pad, self._homes.get(id(s))) for target in targets)
            case ast.AnnAssign(
                target=ast.Name(id=name) as target, annotation=hint, value=ast.expr() as value
            ):
                self._locals.setdefault(name, self._hinted(hint))
                return self._assign(target, value, pad, self._homes.get(id(s)))
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

    def _return(self, value: ast.expr, pad: str) -> str:
        """The end of the function."""
        if self._result in PLAIN:
            return f"{pad}return {self._as(value, self._result)};\n"
        buffers = len(self._buffers)
        found = self._fit(value, self._result)
        if found.place == LASTING and self._is_given(found.code):
            self._t.lending.add(self._f)
            return f"{pad}return {self._at(found)};\n"
        del self._buffers[buffers:]
        return f"{self._build('(*out_)', value, self._result, pad)}{pad}return out_;\n"

    def _is_given(self, code: str) -> bool:
        """Whether a place is one that the caller has, or a constant's."""
        return not _OWN.search(code) and not set(_AT.findall(code)) & self._changed

    def _build(self, target: str, node: ast.expr, t: Type, pad: str) -> str:
        """Make a value where nothing else is.

        Args:
            target: its place in C, which nothing refers to.
            node: the value.
            t: its type.
            pad: before each line.
        """
        match node:
            case ast.Tuple(elts=elements) if isinstance(t, tuple) and len(t) == len(elements):
                inside = zip(elements, fields_of(t), strict=True)
                return "".join(self._build(f"{target}.{field}", one, of, pad) for one, (field, of) in inside)
            case ast.IfExp(test=test, body=body, orelse=orelse) if t not in PLAIN:
                one, other = (self._build(target, part, t, pad + "  ") for part in (body, orelse))
                return f"{pad}if ({self._truth(test)}) {{\n{one}{pad}}} else {{\n{other}{pad}}}\n"
            case ast.Constant(value=None) if isinstance(t, Maybe) and are_numbers(t):
                return f"{pad}{target}.some = 0;\n"
            case ast.Call() if t not in PLAIN:
                text = self._build_call(target, node, t, pad)
                if text is not None:
                    return text
        code = self._as(node, t)
        return "" if code == target else f"{pad}{target} = {code};\n"

    def _build_call(self, target: str, node: ast.Call, t: Type, pad: str) -> str | None:
        """As `_build`, of a call that gives a record; None where that is of another type."""
        func, keywords = node.func, node.keywords
        if isinstance(func, ast.Attribute) and func.attr == "_replace":
            buffers = len(self._buffers)
            whole = self._expr(func.value)
            changed = {k.arg: k.value for k in keywords}
            if whole.type is not t or not set(changed) <= {name for name, _ in fields_of(t)}:
                del self._buffers[buffers:]
                return None
            parts = [
                self._build(f"{target}.{name}", changed[name], of, pad)
                for name, of in fields_of(t)
                if name in changed
            ]
            return f"{pad}{target} = {whole.code};\n{''.join(parts)}"
        called = self._function_of(func, keywords, node)
        inner, some = (t.of, f"{pad}{target}.some = 1;\n") if isinstance(t, Maybe) else (t, "")
        if called is inner and isinstance(called, type):
            place = f"{target}.value" if some else target
            return some + "".join(
                self._build(f"{place}.{name}", one, of, pad)
                if isinstance(one, ast.expr)
                else f"{pad}{place}.{name} = {self._t.kept(one, of).code};\n"
                for name, one, of in self._given(called, node.args, keywords, node)
            )
        if not inspect.isfunction(called) or self._t.result(called) != t:
            return None
        given = [one for _, one in self._arguments(called, node.args, keywords, node)]
        made = self._at(self._called(called, given, f"&{target}"))
        if called not in self._t.lending:
            return f"{pad}{made};\n"
        part, c = self._new("part"), self._t.type(t)
        return f"{pad}{{ const {c} *{part} = {made}; if ({part} != &{target}) {target} = *{part}; }}\n"

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

    def _assign(self, target: ast.expr, value: ast.expr, pad: str, home: str | None = None) -> str:
        if isinstance(target, ast.Name):
            text, found = self._made(value, self._locals.get(target.id), pad, home)
            return text + self._set(target.id, found, pad)
        if not isinstance(target, ast.Tuple):
            raise self._fail(target)
        names = [element.id if isinstance(element, ast.Name) else None for element in target.elts]
        # everything is evaluated before anything is assigned
        text, parts = self._apart(value, pad)
        if None in names or len(parts) != len(names):
            raise self._fail(target)
        return text + "".join(
            self._set(str(name), part, pad) for name, part in zip(names, parts, strict=True)
        )

    def _apart(self, value: ast.expr, pad: str) -> tuple[str, list[Typed]]:
        """The parts of a value, which stay what they are whatever is assigned."""
        if isinstance(value, ast.Tuple):
            text, parts = "", []
            for element in value.elts:
                more, found = self._made(element, None, pad)
                part, c = self._new("part"), self._t.type(found.type)
                if found.type in PLAIN:
                    text += f"{more}{pad}{c} {part} = {found.code};\n"
                    parts.append(Typed(part, found.type))
                else:
                    text += f"{more}{pad}const {c} *{part} = {self._at(found)};\n"
                    parts.append(Typed(f"(*{part})", found.type, LASTING))
            return text, parts
        text, found = self._made(value, None, pad)
        whole = self._new("whole")
        text += f"{pad}const {self._t.type(found.type)} *{whole} = {self._at(found)};\n"
        return text, [Typed(f"(*{whole}).{field}", t, LASTING) for field, t in fields_of(found.type)]

    def _made(self, node: ast.expr, t: Type, pad: str, home: str | None = None) -> tuple[str, Typed]:
        """A number, or a record in a place where it stays; and the statements that lead to it.

        Args:
            node: the value.
            t: the type that is expected, None for any.
            pad: before each line.
            home: where it goes if it is made anew and of the type of that place.
        """
        buffers = len(self._buffers)
        found = self._expr(node)
        if found.type in PLAIN or found.type is NoneType or t in PLAIN:
            return "", found
        if found.place == LASTING and home is None and (t is None or t == found.type):
            return "", found
        del self._buffers[buffers:]
        t = found.type if t is None else t
        if home is None or t != self._home_type(home):
            home = self._buffer(t)
        return self._build(home, node, t, pad), Typed(home, t, LASTING)

    def _home_type(self, home: str) -> Type:
        """The type of the result, or of a part of it."""
        field = home.partition(".")[2]
        return dict(fields_of(self._result))[field] if field else self._result

    def _set(self, name: str, value: Typed, pad: str) -> str:
        if name == "_":
            return ""
        known = self._locals.setdefault(name, value.type)
        if known in PLAIN:
            if known != value.type and not (known is float and value.type is int):
                raise TranslationError(f"{self._f.__name__}: {name} changes its type")
            return f"{pad}{LOCAL}{name} = {value.code};\n"
        if known != value.type:
            if not isinstance(known, Maybe):
                raise TranslationError(f"{self._f.__name__}: {name} changes its type")
            value = self._fitted(value, known)
        if name in self._copied:
            return f"{pad}{LOCAL}{name} = {value.code};\n"
        if value.place == VALUE:
            buffer = self._buffer(known)
            return f"{pad}{buffer} = {value.code};\n{pad}{self._pointer(name)} = &{buffer};\n"
        return f"{pad}{self._pointer(name)} = {self._at(value)};\n"


def _is_to(s: ast.Assign | ast.AnnAssign, name: str) -> bool:
    """Whether it gives something to this name alone."""
    targets = s.targets if isinstance(s, ast.Assign) else [s.target]
    return len(targets) == 1 and isinstance(targets[0], ast.Name) and targets[0].id == name


def _definition(f: FunctionType) -> ast.FunctionDef:
    """Of a function, as its file has it.

    Raises:
        OSError: there is no file.
        BuildError: what stands there now is another one; no branch that is left out would do for that.
    """
    file = f.__code__.co_filename
    passing = (SyntaxError, IndexError, TokenError, *((OSError,) if Path(file).exists() else ()))
    with suppress(*passing):
        found = ast.parse(textwrap.dedent(inspect.getsource(f))).body[0]
        if isinstance(found, ast.FunctionDef) and found.name == f.__name__ and _is_loaded(f):
            return found
    raise BuildError(f"{file} is not what was loaded of it, at {f.__name__}: begin anew")


def _is_loaded(f: FunctionType) -> bool:
    """Whether its code is what is made of its file as that is now."""
    code = f.__code__
    now = _codes(code.co_filename, "".join(linecache.getlines(code.co_filename)))
    return any(one.co_firstlineno == code.co_firstlineno and doings(one) == doings(code) for one in now)


@lru_cache(maxsize=256)
def _codes(file: str, text: str) -> list[CodeType]:
    """All code of a text: that of one function alone may be another than within its module."""
    found, last = [compile(text, file, "exec", dont_inherit=True)], 0
    while last < len(found):
        found += [one for one in found[last].co_consts if isinstance(one, CodeType)]
        last += 1
    return found


def _is_stored(node: ast.AST) -> TypeGuard[ast.Name]:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
