/* Encoder, pressures and valve of another maker on a CAN bus, with a cylinder between them: it takes the place of
 * pneud's software plant, shares no line with it, and protects its frames by AUTOSAR's rules (foreign.dbc).
 *
 *   node IF [TIMEOUT_MS]   on a SocketCAN interface, until SIGINT or SIGTERM
 *   node - [TIMEOUT_MS]    frames on standard input, answers on standard output: 8 bytes of time [ns] and a
 *                          struct can_frame each, as long as there is input; any other frame lets time go on
 *
 * Air keeps its temperature, the valve follows with a first-order lag, flow is an ellipse over the pressure ratio,
 * friction a smooth step and a slope; all of it is integrated explicitly, 50 µs a step.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <math.h>
#include <net/if.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { SYNC = 0x080, POSITION = 0x1A5, PRESSURES = 0x2B1, STATUS = 0x2B3, SETPOINT = 0x321 };
enum { BOOT, CENTRED, ENABLED, TIMED_OUT };

static const double STEP_S = 50e-6;
static const double AREA_1 = 12.566e-4, AREA_2 = 10.566e-4, STROKE = 1.0, DEAD_1 = 0.015, DEAD_2 = 0.015; /* m², m */
static const double MASS = 15.0, COULOMB = 35.0, VISCOUS = 70.0, SMOOTH = 0.004; /* kg, N, N s/m, m/s */
static const double SUPPLY = 6.0e5, AIR = 1.01e5, RT = 287.0 * 293.0; /* Pa, J/kg */
static const double CHOKED = 6.4e-8, RATIO = 0.35; /* kg/(s Pa) wholly open; critical ratio */
static const double DEAD_V = 0.1, FULL_V = 5.0, LAG_S = 1.0 / (2.0 * M_PI * 70.0);

static struct {
  double x, v, p1, p2, spool; /* m, m/s, Pa, Pa, V */
  double asked; /* V */
  int64_t now_ns, heard_ns, timeout_ns;
  int mode, alive; /* alive: counter of the last setpoint */
  uint8_t counts[3];
} rig = {.x = 0.45, .p1 = 3.36e5, .p2 = 3.8e5, .alive = -1};

static uint8_t crc8(uint8_t polynomial, uint8_t crc, const uint8_t *data, int bytes) {
  while (bytes--) {
    crc ^= *data++;
    for (int bit = 0; bit < 8; bit++) crc = crc & 0x80 ? (uint8_t)(crc << 1) ^ polynomial : (uint8_t)(crc << 1);
  }
  return crc;
}

static uint16_t crc16(uint16_t crc, const uint8_t *data, int bytes) {
  while (bytes--) {
    crc ^= (uint16_t)(*data++ << 8);
    for (int bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? (uint16_t)(crc << 1) ^ 0x1021 : (uint16_t)(crc << 1);
  }
  return crc;
}

/* Mass flow [kg/s] from one pressure to another through an edge that is so far open. */
static double flow(double from, double to, double opening) {
  if (opening <= 0.0) return 0.0;
  if (from < to) return -flow(to, from, opening);
  double over = (to / from - RATIO) / (1.0 - RATIO);
  if (over <= 0.0) return CHOKED * opening * from;
  /* near equal pressures the ellipse is infinitely steep; a straight line is not */
  double root = over > 0.999 ? (1.0 - over) * 44.71 : sqrt(1.0 - over * over);
  return CHOKED * opening * from * root;
}

static void step(double h) {
  rig.spool += h / LAG_S * (rig.asked - rig.spool);
  double way = fabs(rig.spool) - DEAD_V;
  double opening = way <= 0.0 ? 0.0 : fmin(1.0, way / (FULL_V - DEAD_V));
  double to_1 = rig.spool > 0.0 ? flow(SUPPLY, rig.p1, opening) : -flow(rig.p1, AIR, opening);
  double to_2 = rig.spool > 0.0 ? -flow(rig.p2, AIR, opening) : flow(SUPPLY, rig.p2, opening);
  rig.p1 += h * (to_1 * RT - rig.p1 * AREA_1 * rig.v) / (AREA_1 * (DEAD_1 + rig.x));
  rig.p2 += h * (to_2 * RT + rig.p2 * AREA_2 * rig.v) / (AREA_2 * (DEAD_2 + STROKE - rig.x));
  double force = rig.p1 * AREA_1 - rig.p2 * AREA_2 - AIR * (AREA_1 - AREA_2);
  double end = rig.x < 0.0 ? -rig.x : rig.x > STROKE ? STROKE - rig.x : 0.0;
  if (end != 0.0) force += 2e6 * end - 3e3 * rig.v;
  force -= COULOMB * tanh(rig.v / SMOOTH) + VISCOUS * rig.v;
  rig.v += h * force / MASS;
  rig.x += h * rig.v;
}

static void until(int64_t t_ns) {
  if (!rig.now_ns) rig.now_ns = t_ns;
  while (rig.now_ns < t_ns) {
    if (rig.mode == ENABLED && rig.now_ns - rig.heard_ns > rig.timeout_ns) rig.mode = TIMED_OUT, rig.asked = 0.0;
    int64_t left_ns = t_ns - rig.now_ns, step_ns = (int64_t)(STEP_S * 1e9);
    if (left_ns < step_ns) step_ns = left_ns;
    step(1e-9 * (double)step_ns);
    rig.now_ns += step_ns;
  }
}

static void put16(uint8_t *at, long value) {
  at[0] = value & 0xFF;
  at[1] = value >> 8 & 0xFF;
}

/* The three answers to SYNC. */
static void sample(struct can_frame answer[3]) {
  memset(answer, 0, 3 * sizeof *answer);
  if (rig.mode == BOOT) rig.mode = CENTRED;

  uint8_t *d = answer[0].data;
  long um = lround(1e6 * rig.x);
  answer[0].can_id = POSITION, answer[0].can_dlc = 8;
  d[1] = rig.counts[0];
  d[2] = 1; /* it has its zero */
  for (int i = 0; i < 4; i++) d[3 + i] = um >> (24 - 8 * i) & 0xFF;
  d[0] = crc8(0x1D, crc8(0x1D, 0, (const uint8_t[]){POSITION & 0xFF, POSITION >> 8}, 2), d + 1, 7);
  rig.counts[0] = (rig.counts[0] + 1) % 15;

  d = answer[1].data;
  answer[1].can_id = PRESSURES, answer[1].can_dlc = 8;
  put16(d, lround(rig.p1 / 20.0));
  put16(d + 2, lround(rig.p2 / 20.0));
  put16(d + 4, lround(SUPPLY / 20.0));
  d[6] = rig.counts[1]++;
  for (int i = 0; i < 7; i++) d[7] ^= d[i];

  d = answer[2].data;
  answer[2].can_id = STATUS, answer[2].can_dlc = 6;
  d[2] = rig.counts[2]++;
  d[3] = (uint8_t)rig.mode;
  put16(d + 4, lround(1e3 * rig.asked));
  put16(d, crc16(crc16(0xFFFF, d + 2, 4), (const uint8_t[]){STATUS & 0xFF, STATUS >> 8}, 2));
}

/* A setpoint that is right in length, checksum and counter moves the valve; any other one changes nothing. */
static void setpoint(const struct can_frame *frame) {
  const uint8_t *d = frame->data;
  uint8_t id = 0x30 + (d[1] & 15), crc = crc8(0x2F, crc8(0x2F, 0xFF, d + 1, 4), &id, 1);
  if (frame->can_dlc != 5 || (d[1] & 15) == rig.alive || (d[0] ^ crc) != 0xFF) return;
  rig.alive = d[1] & 15;
  rig.heard_ns = rig.now_ns;
  if (!(d[1] & 0x10)) rig.mode = CENTRED, rig.asked = 0.0;
  else if (rig.mode != TIMED_OUT) rig.mode = ENABLED, rig.asked = 1e-3 * (int16_t)(d[2] | d[3] << 8);
}

/* How many answers there are to a frame. */
static int hear(const struct can_frame *frame, int64_t t_ns, struct can_frame answer[3]) {
  until(t_ns);
  if (frame->can_id == SETPOINT) setpoint(frame);
  if (frame->can_id != SYNC) return 0;
  sample(answer);
  return 3;
}

static volatile sig_atomic_t going = 1;
static void leave(int number) { (void)number, going = 0; }

static int on_pipe(void) {
  struct { int64_t t_ns; struct can_frame frame; } packet;
  struct can_frame answer[3];
  while (fread(&packet, sizeof packet, 1, stdin) == 1) {
    int count = hear(&packet.frame, packet.t_ns, answer);
    for (int i = 0; i < count; i++) {
      packet.frame = answer[i];
      fwrite(&packet, sizeof packet, 1, stdout);
    }
    fflush(stdout);
  }
  return 0;
}

static int on_can(const char *name) {
  int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
  struct ifreq request = {0};
  strncpy(request.ifr_name, name, IFNAMSIZ - 1);
  struct sockaddr_can address = {.can_family = AF_CAN};
  if (fd < 0 || ioctl(fd, SIOCGIFINDEX, &request) < 0) return fprintf(stderr, "node: %s: %s\n", name, strerror(errno)), 3;
  address.can_ifindex = request.ifr_ifindex;
  if (bind(fd, (struct sockaddr *)&address, sizeof address) < 0)
    return fprintf(stderr, "node: %s: %s\n", name, strerror(errno)), 3;
  fprintf(stderr, "foreign node on %s\n", name);
  while (going) {
    struct pollfd waited = {fd, POLLIN, 0};
    struct can_frame frame, answer[3];
    int ready = poll(&waited, 1, 20);
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    int64_t now_ns = t.tv_sec * 1000000000LL + t.tv_nsec;
    if (ready <= 0) {
      until(now_ns); /* in small portions */
      continue;
    }
    if (read(fd, &frame, sizeof frame) != sizeof frame) continue;
    int count = hear(&frame, now_ns, answer);
    for (int i = 0; i < count; i++)
      if (write(fd, &answer[i], sizeof answer[i]) < 0) perror("node: write");
  }
  close(fd);
  return 0;
}

int main(int argc, char **argv) {
  if (argc < 2 || argc > 3) return fprintf(stderr, "usage: node IF|- [TIMEOUT_MS]\n"), 2;
  rig.timeout_ns = (int64_t)(1e6 * (argc > 2 ? atof(argv[2]) : 50.0));
  signal(SIGINT, leave);
  signal(SIGTERM, leave);
  return strcmp(argv[1], "-") ? on_can(argv[1]) : on_pipe();
}
