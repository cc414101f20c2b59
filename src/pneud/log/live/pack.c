/* What `pneud.log.live.packing.packed` does, in C: a tree of tuples, numbers, bytes and None as `marshal` writes it, but
   straight into its place, with tuples and numbers of any class. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the order of marshal");

typedef struct { char *at, *end; } Place;

static int put(Place *place, const void *data, Py_ssize_t size) {
  if (place->end - place->at < size) return PyErr_SetString(PyExc_ValueError, "pack: no room"), -1;
  memcpy(place->at, data, size);
  place->at += size;
  return 0;
}

static int put_coded(Place *place, char code, const void *data, Py_ssize_t size) {
  return put(place, &code, 1) || put(place, data, size) ? -1 : 0;
}

static int put_integer(Place *place, long long x) {
  int n = (int)x;
  if (n == x) return put_coded(place, 'i', &n, sizeof n);
  char digits[4 + 2 * 5]; /* their number with the sign of x, then 15 bits each */
  n = 0;
  for (unsigned long long rest = x < 0 ? 0ULL - x : x; rest; rest >>= 15, n++) {
    unsigned short digit = rest & 0x7FFF;
    memcpy(digits + 4 + 2 * n, &digit, sizeof digit);
  }
  int signed_n = x < 0 ? -n : n;
  memcpy(digits, &signed_n, sizeof signed_n);
  return put_coded(place, 'l', digits, 4 + 2 * n);
}

static int put_any(Place *place, PyObject *value) {
  if (PyFloat_Check(value)) {
    double x = PyFloat_AS_DOUBLE(value);
    return put_coded(place, 'g', &x, sizeof x);
  }
  if (PyLong_Check(value)) {
    long long x = PyLong_AsLongLong(value);
    return x == -1 && PyErr_Occurred() ? -1 : put_integer(place, x);
  }
  if (value == Py_None) return put(place, "N", 1);
  int n = (int)Py_SIZE(value);
  if (PyBytes_Check(value))
    return put_coded(place, 's', &n, sizeof n) || put(place, PyBytes_AS_STRING(value), n) ? -1 : 0;
  if (!PyTuple_Check(value)) return PyErr_SetString(PyExc_ValueError, "pack: no tuple, number or bytes"), -1;
  if (put_coded(place, '(', &n, sizeof n)) return -1;
  for (int i = 0; i < n; i++)
    if (put_any(place, PyTuple_GET_ITEM(value, i))) return -1;
  return 0;
}

/* pack(memory, begin, end, tree) */
static PyObject *pack(PyObject *self, PyObject *const *args, Py_ssize_t n) {
  if (n != 4) return PyErr_SetString(PyExc_TypeError, "pack: memory, begin, end and a tree are expected"), NULL;
  Py_ssize_t begin = PyLong_AsSsize_t(args[1]), end = PyLong_AsSsize_t(args[2]);
  if (PyErr_Occurred()) return NULL;
  Py_buffer memory;
  if (PyObject_GetBuffer(args[0], &memory, PyBUF_WRITABLE)) return NULL;
  Place place = {(char *)memory.buf + begin, (char *)memory.buf + end};
  int failed = begin < 0 || begin > end || end > memory.len;
  if (failed) PyErr_SetString(PyExc_ValueError, "pack: beyond the memory");
  else failed = put_any(&place, args[3]);
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
