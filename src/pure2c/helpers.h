/* What the C made of Python's functions needs: operations that tell where Python would raise. */
#include <limits.h>
#include <math.h>
#include <stdlib.h>

/* Functions of their arguments alone: the same call need not be made twice. */
#define OF_ITS_ARGUMENTS(name) extern double name(double) __attribute__((const));
OF_ITS_ARGUMENTS(atan)
OF_ITS_ARGUMENTS(cos)
OF_ITS_ARGUMENTS(exp)
OF_ITS_ARGUMENTS(expm1)
OF_ITS_ARGUMENTS(log)
OF_ITS_ARGUMENTS(log1p)
OF_ITS_ARGUMENTS(sin)
OF_ITS_ARGUMENTS(tanh)
extern double atan2(double, double) __attribute__((const));
extern double pow(double, double) __attribute__((const));

_Static_assert(sizeof(long) == 8, "integers have 64 bits here");

static int failed_;

static inline double min_(double a, double b) { return b < a ? b : a; }
static inline double max_(double a, double b) { return b > a ? b : a; }
static inline long min_int_(long a, long b) { return b < a ? b : a; }
static inline long max_int_(long a, long b) { return b > a ? b : a; }

static inline double finite_(double x) {
  if (!isfinite(x)) failed_ = 1;
  return x;
}

static inline double over_(double a, double b) {
  if (b == 0.0) failed_ = 1;
  return a / b;
}

static inline long plus_(long a, long b) {
  long c;
  failed_ |= __builtin_add_overflow(a, b, &c);
  return c;
}

static inline long minus_(long a, long b) {
  long c;
  failed_ |= __builtin_sub_overflow(a, b, &c);
  return c;
}

static inline long times_(long a, long b) {
  long c;
  failed_ |= __builtin_mul_overflow(a, b, &c);
  return c;
}

static inline long within_(long index, long count) {
  if (0 <= index && index < count) return index;
  failed_ = 1;
  return 0;
}

/* Bits of an integer that a mask has, of which those beyond C's integers are cut off. */
static inline long masked_(long a, long mask) {
  if (a < 0) failed_ = 1;
  return a & mask;
}

static inline long shifted_(long a, long b) {
  if (0 <= b && a == 0) return 0;
  if (0 <= b && b < 63 && labs(a) <= LONG_MAX >> b) return a * (1L << b);
  failed_ = 1;
  return 0;
}

static inline long whole_(double x) {
  if (fabs(x) < 0x1p53) return (long)x;
  failed_ = 1;
  return 0;
}
