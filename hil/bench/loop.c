/* The control loop of pneud in C, as a measure for the one in Python: the same frames on the same bus with the
 * same plant, the same law and output chain, absolute deadlines, kernel receive stamps, one record a tick copied
 * into a ring. It has no supervisor, no fault table and no console.
 *
 *   loop BUS RATE_HZ SECONDS PRIORITY CPU SET_DEADLINE   run; one JSON object on standard output
 *   loop law                                             a command for each line of measurements
 *
 * BUS is unix:FOLDER (a unixcan channel with one other party) or can:INTERFACE; PRIORITY 0 and CPU -1 leave the
 * scheduling alone. law.h is made from the Python functions of the law: python -m pneud.benchmark.law CONFIG
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "law.h"

enum { SYNC = 0x080, ENCODER = 0x181, PRESSURE = 0x182, STATUS = 0x183, COMMAND = 0x203 };
static const double SETTLE_S = 0.3; /* before anything counts: the plant, too, has to get going */
enum { RECORD_BYTES = 1024, RECORDS = 4096, SYNC_COUNTERS = 240, COMPLETE = 7 };

static void fail(const char *what) {
  fprintf(stderr, "loop: %s: %s\n", what, errno ? strerror(errno) : "not as expected");
  exit(3);
}

static int64_t now_of(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static int64_t now(void) { return now_of(CLOCK_MONOTONIC); }

static uint8_t crc_table[256];

static void make_crc_table(void) {
  for (int i = 0; i < 256; i++) {
    uint8_t c = (uint8_t)i;
    for (int bit = 0; bit < 8; bit++) c = (uint8_t)(c & 0x80 ? c << 1 ^ 0x1D : c << 1);
    crc_table[i] = c;
  }
}

static uint8_t crc(uint32_t id, const uint8_t *data) {
  uint8_t c = crc_table[0xFF ^ (id & 0xFF)];
  c = crc_table[c ^ (id >> 8 & 0xFF)];
  for (int i = 0; i < 7; i++) c = crc_table[c ^ data[i]];
  return c ^ 0xFF;
}

static void stamp_arrivals(int fd) {
  int on = 1;
  if (setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on)) fail("SO_TIMESTAMPNS");
}

/* Joins a unixcan channel: hands the party that is there one end of a socket pair. */
static int join_unixcan(const char *folder) {
  DIR *dir = opendir(folder);
  if (!dir) fail(folder);
  for (struct dirent *entry; (entry = readdir(dir));) {
    if (entry->d_name[0] == '.' || strcmp(entry->d_name, "lock") == 0) continue;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (snprintf(address.sun_path, sizeof address.sun_path, "%s/%s", folder, entry->d_name) >=
        (int)sizeof address.sun_path)
      continue;
    int door = socket(AF_UNIX, SOCK_SEQPACKET, 0), pair[2], size = 1 << 22;
    if (connect(door, (struct sockaddr *)&address, sizeof address)) {
      close(door);
      continue;
    }
    if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, pair)) fail("socketpair");
    for (int i = 0; i < 2; i++) {
      stamp_arrivals(pair[i]);
      setsockopt(pair[i], SOL_SOCKET, SO_SNDBUF, &size, sizeof size);
    }
    union { char bytes[CMSG_SPACE(sizeof(int))]; struct cmsghdr align; } control = {0};
    char answers = 'a';
    struct iovec io = {&answers, 1};
    struct msghdr message = {.msg_iov = &io, .msg_iovlen = 1, .msg_control = control.bytes,
                             .msg_controllen = sizeof control.bytes};
    struct cmsghdr *c = CMSG_FIRSTHDR(&message);
    c->cmsg_level = SOL_SOCKET;
    c->cmsg_type = SCM_RIGHTS;
    c->cmsg_len = CMSG_LEN(sizeof(int));
    memcpy(CMSG_DATA(c), &pair[1], sizeof(int));
    if (sendmsg(door, &message, 0) != 1) fail("joining");
    close(door);
    close(pair[1]);
    closedir(dir);
    return pair[0];
  }
  errno = 0;
  fail("nobody on the channel");
  return -1;
}

static int open_socketcan(const char *name) {
  int fd = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
  struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(name)};
  if (fd < 0 || !address.can_ifindex || bind(fd, (struct sockaddr *)&address, sizeof address)) fail(name);
  stamp_arrivals(fd);
  return fd;
}

/* The next frame that waits, with its stamp on CLOCK_MONOTONIC; 0 where nothing waits. */
static int receive(int fd, struct can_frame *frame, int64_t offset_ns, int64_t *stamp_ns) {
  union { char bytes[CMSG_SPACE(sizeof(struct timespec))]; struct cmsghdr align; } control;
  struct iovec io = {frame, sizeof *frame};
  struct msghdr message = {.msg_iov = &io, .msg_iovlen = 1, .msg_control = control.bytes,
                           .msg_controllen = sizeof control.bytes};
  ssize_t count = recvmsg(fd, &message, MSG_DONTWAIT);
  if (count != sizeof *frame) {
    if (count == 0 || (count < 0 && errno != EAGAIN)) fail("the bus has gone");
    return 0;
  }
  *stamp_ns = 0;
  for (struct cmsghdr *c = CMSG_FIRSTHDR(&message); c; c = CMSG_NXTHDR(&message, c))
    if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SO_TIMESTAMPNS) {
      struct timespec t;
      memcpy(&t, CMSG_DATA(c), sizeof t);
      *stamp_ns = t.tv_sec * 1000000000LL + t.tv_nsec - offset_ns;
    }
  return 1;
}

typedef struct {
  double position, p1, p2, supply, applied;
  int status, valve_state, counters[3], fresh;
} Inputs;

static uint16_t u16(const uint8_t *b) { return (uint16_t)(b[0] | b[1] << 8); }

/* Takes one frame in if it is sound, as pneud's inbox does. */
static void feed(Inputs *in, const struct can_frame *f, int64_t stamp_ns, int64_t sync_ns) {
  int source = (int)f->can_id - ENCODER;
  const uint8_t *b = f->data;
  if (source < 0 || source > 2 || f->can_dlc != 8 || crc(f->can_id, b) != b[7]) return;
  if (in->counters[source] == b[6]) return;
  in->counters[source] = b[6];
  int64_t age_ns = source == 0 ? b[5] * 10000LL : 0;
  if (stamp_ns - age_ns < sync_ns) return;
  if (source == 0) {
    int32_t raw;
    memcpy(&raw, b, 4);
    in->position = raw * 1e-6;
    in->status = b[4];
  } else if (source == 1) {
    in->p1 = u16(b) * 20.0;
    in->p2 = u16(b + 2) * 20.0;
    in->supply = u16(b + 4) * 20.0;
  } else {
    in->applied = (int16_t)u16(b) * 0.0005;
    in->valve_state = b[2];
  }
  in->fresh |= 1 << source;
}

static void real_time(int priority, int cpu) {
  static int latency = 0;
  int fd = open("/dev/cpu_dma_latency", O_WRONLY | O_CLOEXEC);
  if (fd >= 0 && write(fd, &latency, sizeof latency) < 0) close(fd); /* else it stays open on purpose */
  mlockall(MCL_CURRENT | MCL_FUTURE);
  prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
  if (cpu >= 0) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)cpu, &set);
    sched_setaffinity(0, sizeof set, &set);
  }
  struct sched_param p = {.sched_priority = priority};
  if (priority > 0) sched_setscheduler(0, SCHED_FIFO, &p);
}

static void print_list(const char *name, const int64_t *values, long count) {
  printf("\"%s\": [", name);
  for (long i = 0, first = 1; i < count; i++)
    if (values[i] >= 0) {
      printf(first ? "%lld" : ", %lld", (long long)values[i]);
      first = 0;
    }
  printf("], ");
}

static int only_law(void) {
  LawState law;
  double x, p1, p2, supply, applied, t;
  for (int begun = 0; scanf("%lf %lf %lf %lf %lf %lf", &x, &p1, &p2, &supply, &applied, &t) == 6; begun = 1) {
    if (!begun) law = begin(x, p1, p2, supply, LAW);
    law = tick(law, x, p1, p2, supply, applied, t, LAW);
    printf("%.17g\n", law.command_v);
  }
  return 0;
}

int main(int argc, char **argv) {
  make_crc_table();
  if (argc == 2 && strcmp(argv[1], "law") == 0) return only_law();
  if (argc != 7) {
    fprintf(stderr, "usage: loop unix:FOLDER|can:IF RATE_HZ SECONDS PRIORITY CPU SET_DEADLINE\n");
    return 2;
  }
  double rate_hz = atof(argv[2]);
  long settle = (long)(rate_hz * SETTLE_S + 0.5), total = settle + (long)(rate_hz * atof(argv[3]) + 0.5);
  long skipped = 0, incomplete = 0;
  int64_t period = (int64_t)(1e9 / rate_hz + 0.5), set_wait = (int64_t)((double)period * atof(argv[6]));
  const char *bus = strchr(argv[1], ':');
  if (!bus) fail(argv[1]);
  int fd = strncmp(argv[1], "unix:", 5) == 0 ? join_unixcan(bus + 1) : open_socketcan(bus + 1);
  int64_t *lateness = malloc(4 * sizeof *lateness * (size_t)total), *latency = lateness + total,
          *own = latency + total, *wakeup = own + total;
  uint8_t *ring = malloc((size_t)RECORD_BYTES * RECORDS), record[RECORD_BYTES] = {0};
  if (!lateness || !ring) fail("memory");
  memset(lateness, 0xFF, 4 * sizeof *lateness * (size_t)total);
  memset(ring, 0, (size_t)RECORD_BYTES * RECORDS);
  real_time(atoi(argv[4]), atoi(argv[5]));

  LawState law = {0};
  int begun = 0;
  Inputs in = {.counters = {-1, -1, -1}};
  int64_t offset_ns = now_of(CLOCK_REALTIME) - now(), begin_ns = now(), deadline = begin_ns, counted = begin_ns;
  struct rusage before = {0}, after;
  for (long n = 0; n < total; n++) {
    if (n == settle) {
      skipped = incomplete = 0;
      counted = now();
      getrusage(RUSAGE_SELF, &before);
    }
    deadline += period;
    struct timespec until = {deadline / 1000000000LL, deadline % 1000000000LL};
    int slept = now() < deadline;
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {}
    int64_t sync_ns = now(), stamp_ns, newest_ns = 0;
    lateness[n] = sync_ns - deadline;
    if (slept) wakeup[n] = lateness[n];
    long missed = (long)(lateness[n] / period);
    skipped += missed;
    deadline += missed * period;

    struct can_frame frame;
    while (receive(fd, &frame, offset_ns, &stamp_ns)) {}
    struct can_frame sync = {.can_id = SYNC, .can_dlc = 1, .data = {(uint8_t)(n % SYNC_COUNTERS + 1)}};
    in.fresh = 0;
    if (write(fd, &sync, sizeof sync) < 0 && errno != EAGAIN) fail("SYNC");
    for (int64_t left; in.fresh != COMPLETE && (left = sync_ns + set_wait - now()) > 0;) {
      struct timespec timeout = {left / 1000000000LL, left % 1000000000LL};
      struct pollfd readable = {.fd = fd, .events = POLLIN};
      if (ppoll(&readable, 1, &timeout, NULL) > 0)
        while (receive(fd, &frame, offset_ns, &stamp_ns)) {
          feed(&in, &frame, stamp_ns, sync_ns);
          newest_ns = stamp_ns;
        }
    }
    if (in.fresh == COMPLETE) {
      if (!begun) law = begin(in.position, in.p1, in.p2, in.supply, LAW);
      begun = 1;
      double t_s = (double)(sync_ns - begin_ns) * 1e-9;
      law = tick(law, in.position, in.p1, in.p2, in.supply, in.applied, t_s, LAW);
    } else {
      incomplete++;
    }
    int16_t raw = (int16_t)rint(law.command_v / LAW.output.lsb_v);
    struct can_frame command = {.can_id = COMMAND, .can_dlc = 8};
    memcpy(command.data, &raw, 2);
    command.data[2] = (uint8_t)begun;
    command.data[3] = sync.data[0];
    command.data[6] = (uint8_t)n;
    command.data[7] = crc(COMMAND, command.data);
    if (write(fd, &command, sizeof command) < 0 && errno != EAGAIN) fail("VALVE_COMMAND");
    int64_t sent_ns = now();
    memcpy(record, &law, sizeof law);
    memcpy(record + sizeof law, &in, sizeof in);
    memcpy(ring + (size_t)RECORD_BYTES * (size_t)(n % RECORDS), record, RECORD_BYTES);
    if (newest_ns && in.fresh == COMPLETE) {
      latency[n] = sent_ns - newest_ns;
      own[n] = now() - newest_ns;
    }
  }
  getrusage(RUSAGE_SELF, &after);
  double elapsed_s = (double)(now() - counted) * 1e-9;
  double cpu_s = (double)(after.ru_utime.tv_sec - before.ru_utime.tv_sec + after.ru_stime.tv_sec - before.ru_stime.tv_sec) +
                 1e-6 * (double)(after.ru_utime.tv_usec - before.ru_utime.tv_usec + after.ru_stime.tv_usec - before.ru_stime.tv_usec);
  printf("{");
  print_list("lateness_ns", lateness + settle, total - settle);
  print_list("wakeup_ns", wakeup + settle, total - settle);
  print_list("latency_ns", latency + settle, total - settle);
  print_list("own_ns", own + settle, total - settle);
  printf("\"ticks\": %ld, \"skipped\": %ld, \"incomplete\": %ld, \"elapsed_s\": %.9g, \"cpu_s\": {\"loop\": %.9g}, ",
         total - settle, skipped, incomplete, elapsed_s, cpu_s);
  printf("\"page_faults\": %ld, \"switches\": [%ld, %ld]}\n",
         after.ru_minflt - before.ru_minflt + after.ru_majflt - before.ru_majflt, after.ru_nvcsw - before.ru_nvcsw,
         after.ru_nivcsw - before.ru_nivcsw);
  return 0;
}
