/* The composite law of pneud (src/pneud/control, src/pneud/physics, src/pneud/safety/output.py) in C, function
 * by function under the same names, so that the two can be read side by side. tests/test_bench.py compares
 * their commands. */
#ifndef LAW_H
#define LAW_H

#include <math.h>
#include <stddef.h>
#include <string.h>

#define X1_MARGIN 1e-3
#define LINEAR_FROM 0.999
#define F1_FLOOR 0.1
#define ROUNDING 4e-16
#define MAX_ITERATIONS 100

enum { OBSERVER_EXPLICIT, OBSERVER_IMPLICIT, OBSERVER_MATCHED };

#define CONSTANTS(X) \
  X(h) X(delay_s) X(before_ee) X(before_er) X(before_re) X(before_rr) X(gas_k) X(atmosphere_pa) \
  X(critical_ratio) X(gamma_choked) X(gamma_linear) X(A1) X(A2) X(M) X(x_e1) X(L) X(c1) X(F1_nominal) \
  X(rod_force_n) X(u_max_v) X(omega_rad_s) X(zeta) X(dead_zone_v) X(alpha) X(beta) X(gamma) X(lambda0) \
  X(lambda1) X(observer_L) X(observer_form) X(k1) X(k2) X(k3) X(a1) X(a2) X(a3) X(eta) X(implicit) \
  X(compensate_d) X(invert_dead_zone) X(dead_zone_band_v) X(use_force) X(use_force_rate) X(amplitude_m) \
  X(omega_reference_rad_s) X(out_u_max_v) X(slew_v_s) X(lsb_v) X(command_lsb_v)

typedef struct {
#define FIELD(name) double name;
  CONSTANTS(FIELD)
#undef FIELD
} Constants;

typedef struct {
  int started;
  double start_m, last_v;
  double x, v, F, x3, innovation;               /* motion */
  double x_hat, d_hat, e3;                      /* observer */
  double integral;                              /* sliding */
  double spool_v, spool_rate_v_s, applied_v;    /* valve */
  double drift, f1_fill, f1_exhaust, force_rate;
} Law;

static Constants P;

/* Sets one constant by its name; returns 0 where there is none of that name. */
static int set_constant(const char *name, double value) {
#define SET(field) if (strcmp(name, #field) == 0) { P.field = value; return 1; }
  CONSTANTS(SET)
#undef SET
  return 0;
}

static double clip(double x, double low, double high) { return fmax(low, fmin(high, x)); }

static double subsonic_factor(double r) {
  double q = pow(r, 1.0 / P.gas_k);
  return sqrt(2.0 / (P.gas_k - 1.0) * q * (q - r));
}

static double flow_factor(double r) {
  if (r <= P.critical_ratio) return P.gamma_choked;
  if (r < LINEAR_FROM) return subsonic_factor(r);
  if (r < 1.0) return P.gamma_linear * (1.0 - r) / (1.0 - LINEAR_FROM);
  return 0.0;
}

static double signed_flow(double upstream_pa, double downstream_pa) {
  if (downstream_pa < upstream_pa) return upstream_pa * flow_factor(downstream_pa / upstream_pa);
  if (upstream_pa < downstream_pa) return -downstream_pa * flow_factor(upstream_pa / downstream_pa);
  return 0.0;
}

static double F0(double x1, double p1, double p2) { return -P.gas_k * (p1 * P.A1 / x1 + p2 * P.A2 / (P.L - x1)); }

static double F1_fill(double x1, double p1, double p2, double supply) {
  double f1 = P.c1 * (signed_flow(supply, p1) / x1 + signed_flow(p2, P.atmosphere_pa) / (P.L - x1));
  return fmax(f1, F1_FLOOR * P.F1_nominal);
}

static double F1_exhaust(double x1, double p1, double p2, double supply) {
  double f1 = P.c1 * (signed_flow(p1, P.atmosphere_pa) / x1 + signed_flow(supply, p2) / (P.L - x1));
  return fmax(f1, F1_FLOOR * P.F1_nominal);
}

static double dead_zone(double u) {
  double excess = fabs(u) - P.dead_zone_v;
  if (excess <= 0.0) return 0.0;
  return copysign(excess * P.u_max_v / (P.u_max_v - P.dead_zone_v), u);
}

static double dead_zone_inverse(double opening_v) {
  double scaled = opening_v * (P.u_max_v - P.dead_zone_v) / P.u_max_v;
  if (P.dead_zone_band_v <= 0.0) return scaled + (opening_v != 0.0 ? copysign(P.dead_zone_v, opening_v) : 0.0);
  return scaled + P.dead_zone_v * clip(opening_v / P.dead_zone_band_v, -1.0, 1.0);
}

static double opening(double spool_v) {
  double u = dead_zone(spool_v);
  return fabs(u) > P.u_max_v ? copysign(P.u_max_v, u) : u;
}

typedef struct { double ee, er, re, rr; } Transition;

static Transition spool_transition(double time_s) {
  double omega = P.omega_rad_s, zeta = P.zeta, damping = zeta * omega, c, s;
  if (omega <= 0.0) return (Transition){0.0, 0.0, 0.0, 0.0};
  if (zeta < 1.0 - 1e-6) {
    double root = omega * sqrt(1.0 - zeta * zeta), scale = exp(-damping * time_s);
    c = scale * cos(root * time_s);
    s = scale * sin(root * time_s) / root;
  } else if (zeta > 1.0 + 1e-6) {
    double root = omega * sqrt(zeta * zeta - 1.0);
    double slow = exp((root - damping) * time_s), fast = exp(-(root + damping) * time_s);
    c = 0.5 * (slow + fast);
    s = 0.5 * (slow - fast) / root;
  } else {
    c = exp(-damping * time_s);
    s = c * time_s;
  }
  return (Transition){c + damping * s, s, -omega * omega * s, c - damping * s};
}

static void spool(double *y, double *rate, double u, Transition t) {
  double e = *y - u;
  *y = u + t.ee * e + t.er * *rate;
  *rate = t.re * e + t.rr * *rate;
}

static double sig(double x, double a) { return copysign(pow(fabs(x), a), x); }

static double explicit_ustar(double w1, double w2, double w3) {
  return -(P.k1 * sig(w1, P.a1) + P.k2 * sig(w2, P.a2) + P.k3 * sig(w3, P.a3));
}

static double implicit_w3(double w1, double w2, double w3) {
  double h = P.h, c1 = h * P.k1, c2 = h * P.k2, c3 = h * P.k3, b1 = w1 + h * w2, b2 = w2, h2 = h * h;
  double at_w3 = c3 * sig(w3, P.a3) + c2 * sig(b2 + h * w3, P.a2) + c1 * sig(b1 + h2 * w3, P.a1);
  if (at_w3 == 0.0) return w3;
  double low = at_w3 > 0.0 ? w3 - at_w3 : w3, high = at_w3 > 0.0 ? w3 : w3 - at_w3;
  double kinks[3] = {0.0, -b2 / h, -b1 / h2};
  for (int i = 0; i < 3; i++) {
    double kink = kinks[i];
    if (low < kink && kink < high) {
      double f = kink + c3 * sig(kink, P.a3) + c2 * sig(b2 + h * kink, P.a2) + c1 * sig(b1 + h2 * kink, P.a1) - w3;
      if (f == 0.0) return kink;
      if (f > 0.0) high = kink; else low = kink;
    }
  }
  double y = 0.5 * (low + high);
  for (int i = 0; i < MAX_ITERATIONS; i++) {
    double e2 = b2 + h * y, e1 = b1 + h2 * y;
    double s3 = c3 * sig(y, P.a3), s2 = c2 * sig(e2, P.a2), s1 = c1 * sig(e1, P.a1);
    double f = y + s3 + s2 + s1 - w3;
    if (fabs(f) <= ROUNDING * (fabs(y) + fabs(s3) + fabs(s2) + fabs(s1) + fabs(w3))) return y;
    if (f > 0.0) high = y; else low = y;
    double slope = 1.0;
    if (y != 0.0) slope += P.a3 * s3 / y;
    if (e2 != 0.0) slope += h * P.a2 * s2 / e2;
    if (e1 != 0.0) slope += h2 * P.a1 * s1 / e1;
    double step = y - f / slope;
    if (!(low < step && step < high)) step = 0.5 * (low + high);
    if (step == low || step == high) return step;
    y = step;
  }
  return y;
}

static void observe_disturbance(Law *l, double x3, double f_mean, double h) {
  double root = P.lambda0 * sqrt(P.observer_L), e = l->e3, size = fabs(e);
  if (P.observer_form == OBSERVER_IMPLICIT) {
    double b = l->x_hat + h * (f_mean + l->d_hat) - x3, c = h * h * P.lambda1 * P.observer_L;
    if (fabs(b) <= c) {
      l->x_hat = x3;
      l->d_hat -= b / h;
      l->e3 = 0.0;
      return;
    }
    double a = h * root, rho = -0.5 * a + sqrt(0.25 * a * a + fabs(b) - c);
    l->e3 = copysign(rho * rho, b);
    l->x_hat = x3 + l->e3;
    l->d_hat -= copysign(h * P.lambda1 * P.observer_L, b);
    return;
  }
  if (P.observer_form == OBSERVER_MATCHED) {
    double trace = 0.0, product = 0.0;
    if (size > 0.0) {
      double scale = h / sqrt(size), discriminant = 0.25 * root * root - P.lambda1 * P.observer_L;
      double spread = sqrt(fabs(discriminant)) * scale, decay = -0.5 * root * scale;
      product = exp(2.0 * decay);
      trace = discriminant < 0.0 ? 2.0 * exp(decay) * cos(spread) : exp(decay + spread) + exp(decay - spread);
    }
    l->x_hat += h * (f_mean + l->d_hat) + (trace - 2.0) * e;
    l->d_hat += (trace - 1.0 - product) * e / h;
  } else {
    double sign = e != 0.0 ? copysign(1.0, e) : 0.0;
    l->x_hat += h * (f_mean + l->d_hat - root * sqrt(size) * sign);
    l->d_hat -= h * P.lambda1 * P.observer_L * sign;
  }
  l->e3 = l->x_hat - x3;
}

static double chamber_length(double position_m) {
  return fmax(X1_MARGIN, fmin(P.L - X1_MARGIN, position_m + P.x_e1));
}

static void start(Law *l, double position, double p1, double p2, double supply) {
  double x1 = chamber_length(position), x3 = p1 * P.A1 - p2 * P.A2;
  memset(l, 0, sizeof *l);
  l->started = 1;
  l->start_m = l->x = position;
  l->F = x3 - P.rod_force_n;
  l->x3 = l->x_hat = x3;
  l->f1_fill = F1_fill(x1, p1, p2, supply);
  l->f1_exhaust = F1_exhaust(x1, p1, p2, supply);
}

/* Returns the mean opening of the valve since the last sample. */
static double observe(Law *l, double position, double p1, double p2, double supply, double applied_v) {
  double dt = P.h, M = P.M, x3 = p1 * P.A1 - p2 * P.A2, drag = P.rod_force_n + l->F, F_before = l->F;
  double x = l->x + dt * (l->v + dt * (l->x3 / 3.0 + x3 / 6.0 - 0.5 * drag) / M);
  double v = l->v + dt * (0.5 * (l->x3 + x3) - drag) / M, r = position - x;
  l->x = x + P.alpha * r;
  l->v = v + P.beta * r / dt;
  l->F -= M * P.gamma * r / (dt * dt);
  l->x3 = x3;
  l->innovation = r;
  double x1 = chamber_length(l->x), drift = F0(x1, p1, p2) * l->v;
  double f1_fill = F1_fill(x1, p1, p2, supply), f1_exhaust = F1_exhaust(x1, p1, p2, supply);

  double before = fmin(P.delay_s, dt), after = dt - before, y = l->spool_v, rate = l->spool_rate_v_s, u_mean;
  double u0 = opening(y);
  spool(&y, &rate, l->applied_v, (Transition){P.before_ee, P.before_er, P.before_re, P.before_rr});
  double u1 = opening(y);
  spool(&y, &rate, applied_v, spool_transition(after));
  double u2 = opening(y);
  if (P.omega_rad_s == 0.0) u_mean = (before * u1 + after * u2) / dt;
  else u_mean = 0.5 * (before * (u0 + u1) + after * (u1 + u2)) / dt;

  double f1_sum = u_mean >= 0.0 ? l->f1_fill + f1_fill : l->f1_exhaust + f1_exhaust;
  observe_disturbance(l, x3, 0.5 * (l->drift + drift + f1_sum * u_mean), dt);
  l->force_rate = (l->F - F_before) / dt;
  l->spool_v = y;
  l->spool_rate_v_s = rate;
  l->applied_v = applied_v;
  l->drift = drift;
  l->f1_fill = f1_fill;
  l->f1_exhaust = f1_exhaust;
  return u_mean;
}

static double act(Law *l, double w1, double w2, double w3, double jerk_d) {
  double ustar = P.implicit != 0.0 ? (implicit_w3(w1, w2, w3) - w3) / P.h : explicit_ustar(w1, w2, w3);
  double s = w3 - l->integral;
  double d = P.compensate_d != 0.0 ? l->d_hat : 0.0, rate = P.use_force_rate != 0.0 ? l->force_rate : 0.0;
  double known = P.M * jerk_d - l->drift - d + rate, reaching;
  if (P.implicit != 0.0) reaching = clip(s / P.h, -P.eta, P.eta);
  else reaching = s != 0.0 ? copysign(P.eta, s) : 0.0;
  double Z = known - P.M * ustar + P.M * reaching;
  double f1 = Z >= 0.0 ? l->f1_fill : l->f1_exhaust, open = Z / f1;
  if (fabs(open) > P.u_max_v) l->integral += P.h * (known - f1 * copysign(P.u_max_v, open)) / P.M;
  else l->integral += P.h * ustar;
  return P.invert_dead_zone != 0.0 ? dead_zone_inverse(open) : open;
}

static double emit(Law *l, double law_v) {
  if (!isfinite(law_v)) return l->last_v = 0.0;
  double room = P.slew_v_s * P.h;
  double limited = clip(clip(law_v, l->last_v - room, l->last_v + room), -P.out_u_max_v, P.out_u_max_v);
  double steps = rint(limited / P.lsb_v);
  if (fabs(steps * P.lsb_v) > P.out_u_max_v) steps -= steps > 0.0 ? 1.0 : -1.0;
  return l->last_v = steps * P.lsb_v;
}

/* One tick: complete measurements in, command [V] out. */
static double command_v(Law *l, double position, double p1, double p2, double supply, double applied, double t_s) {
  int fresh = !l->started;
  if (fresh) start(l, position, p1, p2, supply);
  observe(l, position, p1, p2, supply, applied);
  double w = P.omega_reference_rad_s, a = P.amplitude_m, s = sin(w * t_s), c = cos(w * t_s);
  double force = l->x3 - P.rod_force_n - (P.use_force != 0.0 ? l->F : 0.0);
  double w1 = l->start_m + a * (1.0 - c) - l->x, w2 = a * w * s - l->v, w3 = a * w * w * c - force / P.M;
  if (fresh) l->integral = w3;
  return emit(l, act(l, w1, w2, w3, -a * w * w * w * s));
}

#endif
