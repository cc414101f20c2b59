/* What `pneud.log.packing.pack` does, in C: the same values in the same places, only sooner. What lies between
   the places stays as it is. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

typedef struct { unsigned char code, size; unsigned short offset; } Place;

/* One value at its place: 0, or -1 with an exception. */
static int put(char *at, const Place *place, PyObject *value) {
  at += place->offset;
  switch (place->code) {
    case 'd': {
      double x = PyFloat_AsDouble(value);
      if (x == -1.0 && PyErr_Occurred()) return -1;
      memcpy(at, &x, sizeof x);
      return 0;
    }
    case 'q': {
      long long x = PyLong_AsLongLong(value);
      if (x == -1 && PyErr_Occurred()) return -1;
      memcpy(at, &x, sizeof x);
      return 0;
    }
    case 'Q': case 'I': case 'H': {
      unsigned long long x = PyLong_AsUnsignedLongLong(value);
      if (x == (unsigned long long)-1 && PyErr_Occurred()) return -1;
      if (place->size < 8 && x >> 8 * place->size)
        return PyErr_SetString(PyExc_OverflowError, "pack: an integer is too large"), -1;
      if (place->code == 'Q') *(volatile unsigned long long *)at = x;  /* in one piece */
      else if (place->code == 'I') *(unsigned *)at = (unsigned)x;
      else *(unsigned short *)at = (unsigned short)x;
      return 0;
    }
    case 's': case 'p': {
      if (!PyBytes_Check(value)) return PyErr_SetString(PyExc_TypeError, "pack: bytes are expected"), -1;
      Py_ssize_t length = PyBytes_GET_SIZE(value), room = place->size;
      if (place->code == 'p') room--, at++;
      if (length > room) length = room;
      if (place->code == 'p') at[-1] = (char)length;
      memcpy(at, PyBytes_AS_STRING(value), length);
      memset(at + length, 0, room - length);
      return 0;
    }
  }
  return PyErr_SetString(PyExc_ValueError, "pack: an unknown code"), -1;
}

/* pack(memory, offset, layout, places, parts) */
static PyObject *pack(PyObject *self, PyObject *const *args, Py_ssize_t n) {
  if (n != 5 || !PyBytes_Check(args[3]) || !PyTuple_Check(args[4]))
    return PyErr_SetString(PyExc_TypeError, "pack: other arguments than expected"), NULL;
  Py_ssize_t offset = PyLong_AsSsize_t(args[1]);
  if (offset == -1 && PyErr_Occurred()) return NULL;
  const Place *place = (const Place *)PyBytes_AS_STRING(args[3]);
  const Place *end = place + PyBytes_GET_SIZE(args[3]) / sizeof *place;
  Py_buffer memory;
  if (PyObject_GetBuffer(args[0], &memory, PyBUF_WRITABLE)) return NULL;
  int failed = 0;
  for (Py_ssize_t i = 0; !failed && i < PyTuple_GET_SIZE(args[4]); i++) {
    PyObject *part = PyTuple_GET_ITEM(args[4], i);
    if (!PyTuple_Check(part)) {
      PyErr_SetString(PyExc_TypeError, "pack: a part is no tuple");
      failed = 1;
    }
    for (Py_ssize_t j = 0; !failed && j < PyTuple_GET_SIZE(part); j++, place++) {
      if (place == end || offset < 0 || offset + place->offset + place->size > memory.len) {
        PyErr_SetString(PyExc_ValueError, "pack: more values than places, or no room");
        failed = 1;
      } else failed = put((char *)memory.buf + offset, place, PyTuple_GET_ITEM(part, j));
    }
  }
  if (!failed && place != end) {
    PyErr_SetString(PyExc_ValueError, "pack: fewer values than places");
    failed = 1;
  }
  PyBuffer_Release(&memory);
  return failed ? NULL : Py_NewRef(Py_None);
}

static PyMethodDef methods[] = {
    {"pack", (PyCFunction)(void (*)(void))pack, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "pneud_pack", .m_size = -1, .m_methods = methods};

PyMODINIT_FUNC PyInit_pneud_pack(void) { return PyModule_Create(&module); }
