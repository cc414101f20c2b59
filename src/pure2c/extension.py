"""C source of an extension module whose functions stand in for pure functions.

They take and return what the originals do, NamedTuples included, so that nothing else has to know of them.
Whatever the C cannot do exactly as Python does (another type of argument, an integer beyond 64 bits, an
operation that raises) is left to the original, which is called with the same arguments and does it whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from pure2c.reach import name_of
from pure2c.to_c import Translator
from pure2c.types import PLAIN, Many, Maybe, Type, fields_of, is_flat, plain

_HEAD = """\
#define PY_SSIZE_T_CLEAN
#include <Python.h>

static PyObject *originals_, *classes_;

static inline int take_double(PyObject *o, double *x) {
  if (!PyFloat_CheckExact(o)) return 0;
  *x = PyFloat_AS_DOUBLE(o);
  return 1;
}

static inline int take_long(PyObject *o, long *x) {
  int beyond;
  if (!PyLong_Check(o)) return 0;
  *x = PyLong_AsLongAndOverflow(o, &beyond);
  return !beyond;
}

static inline int take_object(PyObject *o, PyObject **x) {
  *x = o;
  return 1;
}

static inline PyObject *give_object(PyObject *x) { return Py_NewRef(x); }
static inline PyObject *give_double(double x) { return PyFloat_FromDouble(x); }
static inline PyObject *give_long(long x) { return PyLong_FromLong(x); }
static inline PyObject *give_bool(long x) { return PyBool_FromLong(x); }

/* What Python does with a record in C: it gets the record. */
static PyObject *without_held(PyObject *original, PyObject *const *args, Py_ssize_t n) {
  PyObject *whole = n && PyObject_HasAttrString(args[0], "whole")
                        ? PyObject_CallMethod(args[0], "whole", NULL) : Py_XNewRef(n ? args[0] : NULL);
  if (n && !whole) return NULL;
  PyObject *all[n + 1];
  for (Py_ssize_t i = 0; i < n; i++) all[i] = i ? args[i] : whole;
  PyObject *made = PyObject_Vectorcall(original, all, n, NULL);
  Py_XDECREF(whole);
  return made;
}

static PyObject *record(PyTypeObject *class, Py_ssize_t count, PyObject *const *members) {
  PyObject *made = class->tp_alloc(class, count);
#if PY_VERSION_HEX >= 0x030E0000
  if (made) ((PyTupleObject *)made)->ob_hash = -1;
#endif
  for (Py_ssize_t i = 0; i < count; i++) {
    if (!members[i]) Py_CLEAR(made);
    if (made) PyTuple_SET_ITEM(made, i, members[i]);
    else Py_XDECREF(members[i]);
  }
  return made;
}
"""
_TAIL = """\
static PyObject *bind(PyObject *self, PyObject *args) {{
  return PyArg_ParseTuple(args, "O!O!", &PyTuple_Type, &originals_, &PyTuple_Type, &classes_)
             ? (Py_INCREF(originals_), Py_INCREF(classes_), Py_NewRef(Py_None)) : NULL;
}}

static PyObject *left(PyObject *self, PyObject *none) {{
  PyObject *members[{count}];
  for (long i = 0; i < {count}; i++) members[i] = give_long(left_[i]);
  return record(&PyTuple_Type, {count}, members);
}}

static PyMethodDef methods[] = {{
  {{"bind", bind, METH_VARARGS, NULL}},
  {{"left", left, METH_NOARGS, NULL}},
{methods}  {{NULL, NULL, 0, NULL}},
}};

static struct PyModuleDef module = {{
  PyModuleDef_HEAD_INIT, .m_name = "{name}", .m_size = -1, .m_methods = methods
}};

PyMODINIT_FUNC PyInit_{name}(void) {{
  if (0{ready}) return NULL;
  PyObject *made = PyModule_Create(&module);
  if (made && PyModule_AddStringConstant(made, "CLASSES", "{classes}")) Py_CLEAR(made);
  return made;
}}
"""

_HELD = """\
typedef struct {{ PyObject_HEAD {c} value; PyObject *made; }} held_{c};

static void drop_{c}(held_{c} *o) {{
  {c} *x = &o->value;
  {disown}
  Py_XDECREF(o->made);
  PyObject_Free(o);
}}

static PyObject *whole_{c}(held_{c} *o, PyObject *none) {{
  if (!o->made) o->made = {give}(o->value);
  return Py_XNewRef(o->made);
}}

{getters}
static PyMethodDef methods_{c}[] = {{{{"whole", (PyCFunction)whole_{c}, METH_NOARGS, NULL}}, {{NULL}}}};
static PyGetSetDef fields_{c}[] = {{
{table}  {{NULL}},
}};
static PyTypeObject held_type_{c} = {{
  PyVarObject_HEAD_INIT(NULL, 0)
  .tp_name = "held", .tp_basicsize = sizeof(held_{c}), .tp_dealloc = (destructor)drop_{c},
  .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
  .tp_methods = methods_{c}, .tp_getset = fields_{c},
}};

static PyObject *hold_{c}(const {c} *x) {{
  held_{c} *o = PyObject_New(held_{c}, &held_type_{c});
  if (!o) return NULL;
  o->value = *x;
  o->made = NULL;
  {own}
  return (PyObject *)o;
}}

static const {c} *reach_{c}(PyObject *o, {c} *x) {{
  if (Py_TYPE(o) == &held_type_{c}) return &((held_{c} *)o)->value;
  return {take}(o, x) ? x : NULL;
}}
"""

_SERIES = """\
/* series(given, rows, state, …): as often as there is something given, or until C cannot do it. */
static PyObject *series_{i}(PyObject *self, PyObject *const *args, Py_ssize_t n) {{
{declared}  Py_buffer given = {{0}}, rows = {{0}};
  PyObject *found = NULL;
  if (!(n == {count} + 1{taken})) {{
    PyErr_SetString(PyExc_TypeError, "series: not these arguments");
    return NULL;
  }}
  int got = !PyObject_GetBuffer(args[0], &given, PyBUF_SIMPLE);
  if (got && !PyObject_GetBuffer(args[1], &rows, PyBUF_WRITABLE)) {{
    Py_ssize_t most = given.len / sizeof({given}), done = 0, room = rows.len / sizeof({row});
    if (room < most) PyErr_SetString(PyExc_ValueError, "series: too few rows");
    else {{
      const {given} *given_ = given.buf;
      {made} others_[2]; /* by turns, so that no state has to be copied */
      const {state} *at0 = &a0;
      for (; done < most; done++) {{
        failed_ = 0;
        const {made} *r = {called};
        if (failed_) break;
        at0 = &r->f0;
        (({row} *)rows.buf)[done] = r->f1;
      }}
      PyObject *state = {give}(*at0);
      if (state) found = Py_BuildValue("Nn", state, done);
    }}
  }}
  if (given.obj) PyBuffer_Release(&given);
  if (rows.obj) PyBuffer_Release(&rows);
  return found;
}}
"""

FEW = 8  # numbers that a record may have without being remembered


class Extension:
    """The module for some functions: `source` is its C.

    Once loaded, `f0`, `f1` … are the functions in their order; `CLASSES` names the NamedTuples that they
    take and return ("module:name …"). First of all, `bind` has to be given the originals and these classes.
    `left` says how often each function has been left to its original. `h0`, `h1` … take their first argument
    as they left it and leave it in C, where it is a record that the result begins with (`Held`); `r0`, `r1` …
    do as much and forget what comes of it.
    """

    def __init__(self, functions: Sequence[Callable[..., Any]], name: str) -> None:
        """Translate.

        Args:
            functions: pure functions; only calls with all arguments by position are fast.
            name: of the module.

        Raises:
            TranslationError: one of them does something that has no counterpart in C.
        """
        self._classes: list[str] = []
        self._translator = Translator()
        self._parts: list[str] = []
        self._known: set[str] = set()
        self._gives: dict[Any, str] = {}  # by annotation: bools are none of C's types
        self._holding: dict[int, str] = {}  # by function: C's type of the record that stays in C
        self._series: list[int] = []
        wrappers = [self._wrapper(i, f) for i, f in enumerate(functions)]
        table = "".join(
            f'  {{"f{i}", (PyCFunction)(void (*)(void))call_{i}, METH_FASTCALL | METH_KEYWORDS, NULL}},\n'
            for i in range(len(functions))
        )
        for t in self._translator.many():
            self._take(t)
        count = len(functions)
        table += "".join(
            f'  {{"{short}{i}", (PyCFunction){name}_{i}, METH_FASTCALL, NULL}},\n'
            for i in self._holding
            for short, name in (("h", "hold"), ("r", "rehearse"))
        )
        table += "".join(
            f'  {{"s{i}", (PyCFunction)(void (*)(void))series_{i}, METH_FASTCALL, NULL}},\n'
            for i in self._series
        )
        tail = _TAIL.format(
            methods=table,
            name=name,
            classes=" ".join(self._classes),
            count=count,
            ready="".join(f" || PyType_Ready(&held_type_{c})" for c in dict.fromkeys(self._holding.values())),
        )
        head = f"{_HEAD}\nstatic long left_[{count}];\n"
        self.source = "\n".join([self._translator.text(), head, *self._parts, *wrappers, tail])

    def _wrapper(self, index: int, f: Callable[..., Any]) -> str:
        hints = get_type_hints(f)
        result = hints.pop("return")
        name = self._translator.function(f)
        types = [plain(hint) for hint in hints.values()]
        declared = "".join(f"  {self._translator.type(t)} a{i};\n" for i, t in enumerate(types))
        taken = " && ".join(f"{self._take(t)}(args[{i}], &a{i})" for i, t in enumerate(types)) or "1"
        given = [f"a{i}" if t in PLAIN else f"&a{i}" for i, t in enumerate(types)]
        c = self._translator.type(plain(result))
        called, got = f"{c} r = {name}({', '.join(given)});", "r"
        if plain(result) not in PLAIN:
            declared += f"  {c} made_;\n"
            called, got = f"const {c} *r = {name}({', '.join(('&made_', *given))});", "*r"
        text = (
            f"static PyObject *call_{index}(PyObject *self, PyObject *const *args, Py_ssize_t n,"
            f" PyObject *names) {{\n{declared}  if (!names && n == {len(types)} && {taken}) {{\n"
            f"    failed_ = 0;\n    {called}\n"
            f"    if (!failed_) return {self._give(result)}({got});\n"
            f"  }}\n  left_[{index}]++;\n"
            f"  return PyObject_Vectorcall(PyTuple_GET_ITEM(originals_, {index}), args, n, names);\n}}\n"
        )
        if _is_series(result, types):
            self._series.append(index)
            text += _SERIES.format(
                i=index,
                count=len(types),
                declared=declared,
                taken="".join(
                    f" && {self._take(t)}(args[{i + 1}], &a{i})" for i, t in enumerate(types) if i != 1
                ).replace("args[1]", "args[2]", 1),
                given=self._translator.type(types[1]),
                row=self._translator.type(plain(result)[1]),
                state=self._translator.type(types[0]),
                made=c,
                called=f"{name}({', '.join(('&others_[done & 1]', 'at0', 'given_ + done', *given[2:]))})",
                give=self._give(get_args(result)[0]),
            )
        first, parts = next(iter(hints.values()), None), get_args(result)
        if get_origin(result) is tuple and first == parts[0] and _is_remembered(first):
            c = self._holding[index] = self._held(first)
            first_taken, _, others = taken.partition(" && ")
            at = f"(at0 = {first_taken.replace('take_', 'reach_', 1)})"
            reached = " && ".join(filter(None, (f"n == {len(types)}", at, others)))
            declared += f"  const {c} *at0;\n"
            text += self._holding_wrapper(index, c, parts, declared, reached, called.replace("&a0", "at0", 1))
        return text

    def _holding_wrapper(
        self, index: int, c: str, parts: Sequence[Any], declared: str, reached: str, called: str
    ) -> str:
        """The function whose first argument and result's first part stay in C, and that which forgets it."""
        given = [f"{self._give(part)}(r->f{i})" for i, part in enumerate(parts) if i]
        rest = "".join(f", {one}" for one in given)
        return (
            f"static PyObject *hold_{index}(PyObject *self, PyObject *const *args, Py_ssize_t n) {{\n"
            f"{declared}  if ({reached}) {{\n"
            f"    failed_ = 0;\n    {called}\n    if (!failed_) {{\n"
            f"      PyObject *members[] = {{hold_{c}(&r->f0){rest}}};\n"
            f"      return record(&PyTuple_Type, {len(parts)}, members);\n    }}\n"
            f"  }}\n  left_[{index}]++;\n"
            f"  return without_held(PyTuple_GET_ITEM(originals_, {index}), args, n);\n}}\n"
            f"static PyObject *rehearse_{index}(PyObject *self, PyObject *const *args, Py_ssize_t n) {{\n"
            f"{declared}  int done = 0;\n  if ({reached}) {{\n    failed_ = 0;\n    {called}\n"
            f"    if (!failed_) {{ {' '.join(f'Py_XDECREF({one});' for one in given)} }}\n"
            "    done = !failed_;\n  }\n  PyErr_Clear();\n  return PyBool_FromLong(done);\n}\n"
        )

    def _held(self, t: Any) -> str:
        """C's type of a record, for which there is a Python type that holds one."""
        c = self._translator.type(t)
        if c in self._holding.values():
            return c
        take, give = self._take(t), self._give(t)
        owned = [f"x->{path}" for path in _objects(t)]
        fields = fields_of(t)
        hints = get_type_hints(t)
        getters = [self._give(hints[field]) for field, _ in fields]
        self._parts.append(
            _HELD.format(
                c=c,
                take=take,
                give=give,
                own=" ".join(f"Py_XINCREF({one});" for one in owned),
                disown=" ".join(f"Py_XDECREF({one});" for one in owned),
                getters="".join(
                    f"static PyObject *get_{c}_{field}(held_{c} *o, void *none) {{"
                    f" return {getter}(o->value.{field}); }}\n"
                    for (field, _), getter in zip(fields, getters, strict=True)
                ),
                table="".join(f'  {{"{field}", (getter)get_{c}_{field}}},\n' for field, _ in fields),
            )
        )
        return c

    def _take(self, t: Type) -> str:
        """The C function that reads a Python object of a type."""
        name = f"take_{self._suffix(t)}"
        if t in PLAIN or name in self._known:
            return name
        c = self._translator.type(t)
        self._known.add(name)
        if isinstance(t, Many):
            take, of = self._take(t.of), self._translator.type(t.of)
            self._parts.append(
                f"static int {name}(PyObject *o, {c} *x) {{\n  if (!PyTuple_CheckExact(o)) return 0;\n"
                f"  *x = ({c}){{PyTuple_GET_SIZE(o), o, 0}};\n  return 1;\n}}\n\n"
                f"static {of} {self._translator.item(t)}({c} x, long i) {{\n  {of} found = {{0}};\n"
                "  i = within_(i, x.count);\n  if (failed_) return found;\n  if (!x.tuple) return x.at[i];\n"
                f"  failed_ = !{take}(PyTuple_GET_ITEM(x.tuple, i), &found);\n  return found;\n}}\n"
            )
            return name
        if isinstance(t, Maybe):
            self._parts.append(
                f"static int {name}(PyObject *o, {c} *x) {{\n  memset(x, 0, sizeof *x);\n"
                f"  x->some = o != Py_None;\n  return !x->some || {self._take(t.of)}(o, &x->value);\n}}\n"
            )
            return name
        fields = fields_of(t)
        inner = [
            f"{self._take(kind)}(PyTuple_GET_ITEM(o, {i}), &x->{field})"
            for i, (field, kind) in enumerate(fields)
        ]
        fits = " && ".join(
            (f"Py_TYPE(o) == {self._class(t)}", f"PyTuple_GET_SIZE(o) == {len(fields)}", *inner)
        )
        if _is_remembered(t):
            self._parts.append(
                f"static PyObject *last_{c};\nstatic {c} value_{c};\n\n"
                f"static int {name}(PyObject *o, {c} *x) {{\n"
                f"  if (o != last_{c}) {{\n    if (!({fits})) return 0;\n"
                f"    value_{c} = *x;\n    Py_XSETREF(last_{c}, Py_NewRef(o));\n  }} else *x = value_{c};\n"
                "  return 1;\n}\n"
            )
        else:
            self._parts.append(f"static int {name}(PyObject *o, {c} *x) {{\n  return {fits};\n}}\n")
        return name

    def _give(self, hint: Any) -> str:
        """The C function that makes a Python object of a type."""
        if hint is bool:
            return "give_bool"
        t = plain(hint)
        name = self._gives.setdefault(hint, f"give_{len(self._gives)}_{self._suffix(t)}")
        if t in PLAIN:
            return f"give_{self._suffix(t)}"
        if name in self._known:
            return name
        c = self._translator.type(t)
        self._known.add(name)
        if isinstance(t, Many):
            self._parts.append(
                f"static PyObject *{name}({c} x) {{\n  if (x.tuple) return Py_NewRef(x.tuple);\n"
                "  PyObject *made = PyTuple_New(x.count);\n  for (long i = 0; made && i < x.count; i++) {\n"
                f"    PyObject *member = {self._give(get_args(hint)[0])}(x.at[i]);\n"
                "    if (member) PyTuple_SET_ITEM(made, i, member);\n    else Py_CLEAR(made);\n  }\n"
                "  return made;\n}\n"
            )
            return name
        if isinstance(t, Maybe):
            inside = next(inner for inner in get_args(hint) if inner is not NoneType)
            self._parts.append(
                f"static PyObject *{name}({c} x) {{\n"
                f"  return x.some ? {self._give(inside)}(x.value) : Py_NewRef(Py_None);\n}}\n"
            )
            return name
        fields = fields_of(t)
        if get_origin(hint) is tuple:
            inner = list(get_args(hint))
        else:
            hints = get_type_hints(hint)
            inner = [hints[field] for field, _ in fields]
        members = ", ".join(
            f"{self._give(kind)}(x.{field})" for (field, _), kind in zip(fields, inner, strict=True)
        )
        same, keep = "", ""
        if _is_remembered(t):
            self._take(t)
            same = f"  if (last_{c} && !memcmp(&value_{c}, &x, sizeof x)) return Py_NewRef(last_{c});\n"
            keep = f"  if (made) {{\n    Py_XSETREF(last_{c}, Py_NewRef(made));\n    value_{c} = x;\n  }}\n"
        made = f"record({self._class(t)}, {len(fields)}, members)"
        self._parts.append(
            f"static PyObject *{name}({c} x) {{\n{same}  PyObject *members[] = {{{members}}};\n"
            f"  PyObject *made = {made};\n{keep}  return made;\n}}\n"
        )
        return name

    def _class(self, t: Type) -> str:
        """What a record's class is called in C."""
        if not hasattr(t, "_fields"):
            return "&PyTuple_Type"
        name = name_of(t)
        if name not in self._classes:
            self._classes.append(name)
        return f"(PyTypeObject *)PyTuple_GET_ITEM(classes_, {self._classes.index(name)})"

    def _suffix(self, t: Type) -> str:
        return "object" if t is object else self._translator.type(t)


def _is_series(result: Any, types: Sequence[Type]) -> bool:
    """Whether a function takes a state and numbers, and gives the next state and numbers."""
    parts = [plain(part) for part in get_args(result)] if get_origin(result) is tuple else []
    if len(parts) != 2 or len(types) < 2 or parts[0] != types[0]:
        return False
    return all(is_flat(t) and t not in PLAIN for t in (parts[1], types[1]))


def _is_remembered(t: Type) -> bool:
    """Whether the last value of a type is kept: most records are passed on as they are."""
    return isinstance(t, type) and hasattr(t, "_fields") and _count_of(t) > FEW


def _objects(t: Type) -> list[str]:
    """The ways from a record to the Python objects in it."""
    found = []
    for name, kind in fields_of(t):
        if kind is object:
            found.append(name)
        elif isinstance(kind, Many):
            found.append(f"{name}.tuple")
        elif kind not in PLAIN:
            found += [f"{name}.{way}" for way in _objects(kind)]
    return found


def _count_of(t: Type) -> int:
    return 1 if t in PLAIN or isinstance(t, Many) else sum(_count_of(kind) for _, kind in fields_of(t))
