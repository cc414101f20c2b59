/* What `receive` and `send` of `pneud.bus.wire` do, in C: the same frames in the same order, only sooner. */
#define _GNU_SOURCE
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <linux/can.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>

#define FD_FLAG (1ULL << 32) /* beside an identifier: a frame of CAN FD */
#define SWITCH_FLAG (1ULL << 33) /* which switches its bit rate */
enum { SWITCHED = 0x01, FLEXIBLE = 0x04 }; /* flags in the packet of such a frame */
enum { EVENTS = 16, TIMESTAMP = 35, OVERFLOW = 40, ORDERED = -1, UNORDERED = -2 };
enum { DROPPED, MALFORMED };  /* places in the counts */

/* A packet's frame at the end of the list: 1, 0 where the other end has closed, -1 for an exception. */
static int take(int fd, long long offset_ns, PyObject *into, PyTypeObject *class, long long *counts,
                long long *stamp_ns, long long marks) {
  char packet[sizeof(struct canfd_frame) + 1] __attribute__((aligned(8))); /* one more: a longer packet shows */
  char control[CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(unsigned))]
      __attribute__((aligned(8)));
  struct iovec vector = {packet, sizeof packet};
  struct msghdr message = {.msg_iov = &vector, .msg_iovlen = 1, .msg_control = control,
                           .msg_controllen = sizeof control};
  ssize_t count = recvmsg(fd, &message, MSG_DONTWAIT);
  if (count < 0 && (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR || errno == ECONNRESET))
    return 1;  /* a reset comes ahead of what the other end had sent before it died */
  if (count < 0) return PyErr_SetFromErrno(PyExc_OSError), -1;
  if (count == 0) return 0;
  /* both kinds begin alike: identifier, length, three bytes, data */
  const struct canfd_frame *frame = (const struct canfd_frame *)packet;
  int flexible = marks >= 0 && count == sizeof *frame;
  if (!(flexible || count == sizeof(struct can_frame)) || frame->len > (flexible ? CANFD_MAX_DLEN : CAN_MAX_DLEN)) {
    counts[MALFORMED]++;
    return 1;
  }
  long long stamp = 0;
  for (struct cmsghdr *c = CMSG_FIRSTHDR(&message); c; c = CMSG_NXTHDR(&message, c)) {
    if (c->cmsg_level != SOL_SOCKET) continue;
    if (c->cmsg_type == TIMESTAMP) {
      struct timespec t;
      memcpy(&t, CMSG_DATA(c), sizeof t);
      stamp = t.tv_sec * 1000000000LL + t.tv_nsec - offset_ns;
    } else if (c->cmsg_type == OVERFLOW) {
      unsigned dropped;
      memcpy(&dropped, CMSG_DATA(c), sizeof dropped);
      counts[DROPPED] = dropped;
    }
  }
  *stamp_ns = stamp;
  unsigned long long marked = frame->can_id;
  if (flexible && marks) marked |= marks | (frame->flags & SWITCHED ? SWITCH_FLAG : 0);
  PyObject *made = class->tp_alloc(class, 3);
  if (!made) return -1;
#if PY_VERSION_HEX >= 0x030E0000
  ((PyTupleObject *)made)->ob_hash = -1;
#endif
  PyTuple_SET_ITEM(made, 0, PyLong_FromLongLong(stamp));
  PyTuple_SET_ITEM(made, 1, PyLong_FromUnsignedLongLong(marked));
  PyTuple_SET_ITEM(made, 2, PyBytes_FromStringAndSize((const char *)frame->data, frame->len));
  int failed = PyErr_Occurred() || PyList_Append(into, made);
  Py_DECREF(made);
  return failed ? -1 : 1;
}

/* receive(epoll, sources, offset_ns, into, most, wait_ns, counts, class, fd) */
static PyObject *receive(PyObject *self, PyObject *const *args, Py_ssize_t n) {
  if (n != 9 || !PyDict_Check(args[1]) || !PyList_Check(args[3]) || !PyType_Check(args[7])
      || !PyType_IsSubtype((PyTypeObject *)args[7], &PyTuple_Type))
    return PyErr_SetString(PyExc_TypeError, "receive: other arguments than expected"), NULL;
  PyObject *sources = args[1], *into = args[3];
  long long offset_ns = PyLong_AsLongLong(args[2]), wait_ns = PyLong_AsLongLong(args[5]);
  long long marks = PyLong_AsLongLong(args[8]);
  Py_ssize_t most = PyLong_AsSsize_t(args[4]);
  if (PyErr_Occurred()) return NULL;
  int epoll = PyObject_AsFileDescriptor(args[0]);
  if (epoll < 0) return NULL;
  Py_buffer counts;
  if (PyObject_GetBuffer(args[6], &counts, PyBUF_WRITABLE)) return NULL;
  if (wait_ns > 0) {
    struct pollfd waited = {epoll, POLLIN, 0};
    struct timespec time = {wait_ns / 1000000000, wait_ns % 1000000000};
    Py_BEGIN_ALLOW_THREADS
    ppoll(&waited, 1, &time, NULL);
    Py_END_ALLOW_THREADS
  }
  long found = ORDERED;
  long long last_ns = 0, stamp_ns = 0;
  Py_ssize_t enough = PyList_GET_SIZE(into) + most;
  int more = PyErr_CheckSignals() == 0, failed = !more;
  while (more && PyList_GET_SIZE(into) < enough) {
    struct epoll_event ready[EVENTS];
    int count = epoll_wait(epoll, ready, EVENTS, 0);
    if (count <= 0) {
      failed = count < 0 && errno != EINTR;
      if (failed) PyErr_SetFromErrno(PyExc_OSError);
      break;
    }
    for (int i = 0; more && i < count; i++) {
      int fd = ready[i].data.fd;
      PyObject *key = PyLong_FromLong(fd);
      int known = key ? PyDict_Contains(sources, key) : -1;
      Py_XDECREF(key);
      int taken = known > 0 ? take(fd, offset_ns, into, (PyTypeObject *)args[7], counts.buf, &stamp_ns, marks)
                            : 0;
      if (known < 0 || taken < 0) failed = 1, more = 0;
      else if (taken == 0) found = fd, more = 0;
      else if (stamp_ns < last_ns) found = UNORDERED;
      last_ns = stamp_ns;
    }
  }
  PyBuffer_Release(&counts);
  return failed ? NULL : PyLong_FromLong(found);
}

/* send(targets, can_id, data, strict) */
static PyObject *send_(PyObject *self, PyObject *const *args, Py_ssize_t n) {
  if (n != 4 || !PyTuple_Check(args[0]) || !PyBytes_Check(args[2]))
    return PyErr_SetString(PyExc_TypeError, "send: other arguments than expected"), NULL;
  unsigned long long marked = PyLong_AsUnsignedLongLong(args[1]);
  if (PyErr_Occurred()) return NULL;
  Py_ssize_t length = PyBytes_GET_SIZE(args[2]);
  /* a classic one begins alike */
  struct canfd_frame frame = {.can_id = (canid_t)marked, .len = (unsigned char)length};
  size_t size = sizeof(struct can_frame);
  if (marked >= FD_FLAG) {
    int step = length <= 8 ? 1 : length <= 24 ? 4 : length <= 32 ? 8 : 16;
    if (length > CANFD_MAX_DLEN || length % step || !(marked & FD_FLAG) || marked >= SWITCH_FLAG << 1)
      return PyErr_SetString(PyExc_ValueError, "send: no frame of CAN FD has so many bytes, or such flags"), NULL;
    frame.flags = FLEXIBLE | (marked & SWITCH_FLAG ? SWITCHED : 0);
    size = sizeof frame;
  } else if (length > CAN_MAX_DLEN) {
    return PyErr_SetString(PyExc_ValueError, "send: more than 8 bytes"), NULL;
  }
  memcpy(frame.data, PyBytes_AS_STRING(args[2]), length);
  long lost = 0;
  for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(args[0]); i++) {
    int fd = PyObject_AsFileDescriptor(PyTuple_GET_ITEM(args[0], i));
    if (fd < 0) {  /* closed by another thread */
      if (args[3] == Py_True || !PyErr_ExceptionMatches(PyExc_ValueError)) return NULL;
      PyErr_Clear();
      continue;
    }
    if (send(fd, &frame, size, MSG_DONTWAIT | MSG_NOSIGNAL) >= 0) continue;
    if (args[3] == Py_True) return PyErr_SetFromErrno(PyExc_OSError);
    lost += errno == EAGAIN || errno == EWOULDBLOCK;
  }
  return PyLong_FromLong(lost);
}

static PyMethodDef methods[] = {
    {"send", (PyCFunction)(void (*)(void))send_, METH_FASTCALL, NULL},
    {"receive", (PyCFunction)(void (*)(void))receive, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "pneud_frames", .m_size = -1, .m_methods = methods};

PyMODINIT_FUNC PyInit_pneud_frames(void) { return PyModule_Create(&module); }
