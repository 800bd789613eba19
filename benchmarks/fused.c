/* The practical limit: a bootstrap filter of one workload written by hand in one loop, single precision, one thread.

   xoshiro128++ [Blackman, Vigna 2021], normals by the ziggurat [Marsaglia, Tsang 2000], systematic resampling at every step,
   mean, variance, effective sample size and evidence at every step. Compiled on the spot by fused.py. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#ifdef __SSE2__
#include <immintrin.h>
#endif

static uint32_t s[4];

static inline uint32_t rotl(uint32_t x, int k) { return (x << k) | (x >> (32 - k)); }

static inline uint32_t word(void) {
  const uint32_t result = rotl(s[0] + s[3], 7) + s[0], t = s[1] << 9;
  s[2] ^= s[0]; s[3] ^= s[1]; s[1] ^= s[2]; s[0] ^= s[3]; s[2] ^= t; s[3] = rotl(s[3], 11);
  return result;
}

static inline float uniform(void) { return ((word() >> 8) + 0.5f) * 0x1p-24f; }

static uint32_t v[4][16]; /* sixteen streams side by side, for the many */
static uint32_t kn[128];
static float wn[128], fn[128];

void seed(uint64_t z) {
  for (int i = 0; i < 4; i++) { /* splitmix64 */
    uint64_t x = (z += 0x9e3779b97f4a7c15ull);
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
    s[i] = (uint32_t)((x ^ (x >> 31)) >> 32);
  }
  for (int k = 0; k < 4; k++)
    for (int j = 0; j < 16; j++) v[k][j] = word() | (k == 0); /* never all zero */
  const double m = 2147483648.0, v = 9.91256303526217e-3;
  double d = 3.442619855899, t = d;
  const double q = v / exp(-0.5 * d * d);
  kn[0] = (uint32_t)(d / q * m); kn[1] = 0;
  wn[0] = (float)(q / m); wn[127] = (float)(d / m);
  fn[0] = 1.0f; fn[127] = (float)exp(-0.5 * d * d);
  for (int i = 126; i >= 1; i--) {
    d = sqrt(-2.0 * log(v / d + exp(-0.5 * d * d)));
    kn[i + 1] = (uint32_t)(d / t * m);
    t = d;
    fn[i] = (float)exp(-0.5 * d * d);
    wn[i] = (float)(d / m);
  }
}

static float rare(int32_t h, uint32_t i) {
  const float r = 3.442620f;
  for (;;) {
    const float x = h * wn[i];
    if (i == 0) {
      float a, b;
      do { a = -logf(uniform()) / r; b = -logf(uniform()); } while (b + b < a * a);
      return h > 0 ? r + a : -r - a;
    }
    if (fn[i] + uniform() * (fn[i - 1] - fn[i]) < expf(-0.5f * x * x)) return x;
    h = (int32_t)word(); i = word() & 127;
    if ((uint32_t)abs(h) < kn[i]) return h * wn[i];
  }
}

static inline float normal(void) {
  const int32_t h = (int32_t)word();
  const uint32_t i = (uint32_t)(h ^ (h >> 16)) & 127; /* of bits that a sign and a size do not use up */
  return (uint32_t)abs(h) < kn[i] ? h * wn[i] : rare(h, i);
}

/* Normals in blocks of sixteen; what falls out of its ziggurat's layer, about one in eighty, is drawn again one by one. */
static void fill(float *out, int n) {
  for (int b = 0; b < n; b += 16) {
    int32_t h[16], bad = 0;
    float x[16];
    for (int j = 0; j < 16; j++) {
      const uint32_t sum = v[0][j] + v[3][j], t = v[1][j] << 9;
      h[j] = (int32_t)(rotl(sum, 7) + v[0][j]);
      v[2][j] ^= v[0][j]; v[3][j] ^= v[1][j]; v[1][j] ^= v[2][j]; v[0][j] ^= v[3][j];
      v[2][j] ^= t; v[3][j] = rotl(v[3][j], 11);
    }
    for (int j = 0; j < 16; j++) {
      const uint32_t i = (uint32_t)(h[j] ^ (h[j] >> 16)) & 127;
      x[j] = h[j] * wn[i];
      bad |= (uint32_t)abs(h[j]) >= kn[i];
    }
    if (bad)
      for (int j = 0; j < 16; j++) {
        const uint32_t i = (uint32_t)(h[j] ^ (h[j] >> 16)) & 127;
        if ((uint32_t)abs(h[j]) >= kn[i]) x[j] = rare(h[j], i);
      }
    const int m = n - b < 16 ? n - b : 16;
    for (int j = 0; j < m; j++) out[b + j] = x[j];
  }
}

/* Weighs by log_w, sums up, and tells which particles to go on from; returns the step's log evidence. Without a branch on what
   was drawn: slots of a particle end where its sum of weights does, and of several that begin at a slot the last one has it. */
static double settle(int n, const float *log_w, float *w, int32_t *ancestor, int32_t *first, float *ess) {
  float top = log_w[0];
  for (int i = 1; i < n; i++) top = log_w[i] > top ? log_w[i] : top;
  float total = 0.0f, square = 0.0f;
  for (int i = 0; i < n; i++) w[i] = expf(log_w[i] - top);
  for (int i = 0; i < n; i++) { total += w[i]; square += w[i] * w[i]; }
  const float scale = 1.0f / total, slots = n * scale, u = uniform();
  for (int i = 0; i <= n; i++) first[i] = 0;
  double reached = 0.0;
  for (int i = 0; i + 1 < n; i++) {
    const int32_t end = (int32_t)ceilf((float)(reached += w[i]) * slots - u);
    first[end < 0 ? 0 : end > n ? n : end] = i + 1;
  }
  int32_t latest = 0;
  for (int j = 0; j < n; j++) ancestor[j] = latest = first[j] > latest ? first[j] : latest;
  for (int i = 0; i < n; i++) w[i] *= scale;
  *ess = total * total / square;
  return top + log(total / n);
}

/* Mean and variance of each component; x is [d][n]. */
static void moments(int n, int d, const float *x, const float *w, double *mean, double *variance) {
  for (int k = 0; k < d; k++) {
    const float *p = x + (size_t)k * n;
    float m = 0.0f, v = 0.0f;
    for (int i = 0; i < n; i++) m += w[i] * p[i];
    for (int i = 0; i < n; i++) v += w[i] * (p[i] - m) * (p[i] - m);
    mean[k] = m; variance[k] = v;
  }
}

/* out [d][n] = m [d][2 d] z [2 d][n], sixteen particles at a time, whose sums stay in registers where d is known. */
static inline __attribute__((always_inline)) void product(int n, const float *m, const float *z, float *out, const int d) {
  int i = 0;
  for (; i + 16 <= n; i += 16)
    for (int c0 = 0; c0 < d; c0 += 15) {
      float sum[15][16] = {{0.0f}};
      const int e = d - c0 < 15 ? d - c0 : 15;
      for (int l = 0; l < 2 * d; l++)
        for (int c = 0; c < e; c++)
          for (int j = 0; j < 16; j++) sum[c][j] += m[(c0 + c) * 2 * d + l] * z[(size_t)l * n + i + j];
      for (int c = 0; c < e; c++)
        for (int j = 0; j < 16; j++) out[(size_t)(c0 + c) * n + i + j] = sum[c][j];
    }
  for (; i < n; i++)
    for (int c = 0; c < d; c++) {
      float sum = 0.0f;
      for (int l = 0; l < 2 * d; l++) sum += m[c * 2 * d + l] * z[(size_t)l * n + i];
      out[(size_t)c * n + i] = sum;
    }
}

/* kind 0 growth, 1 volatility, 2 radar, 3 ins. par: numbers of the model, see fused.py. y [steps][k]; mean [steps][d].
   ins: stepped [steps][d][2 d] = [Phi | L], par = p0 [d], then sd of the k measurements of the states first, first + 1, ... */
double run(int kind, int n, int d, int k, int steps, int first, const float *par, const float *stepped, const float *y,
           double *mean, double *variance, float *ess) {
  float *x = malloc(sizeof(float) * n * d), *next = malloc(sizeof(float) * n * d), *log_w = malloc(sizeof(float) * n);
  float *w = malloc(sizeof(float) * n), *z = malloc(sizeof(float) * n * 2 * d);
  int32_t *ancestor = malloc(sizeof(int32_t) * n), *first_of = malloc(sizeof(int32_t) * (n + 1));
#ifdef __SSE2__
  const unsigned usual = _mm_getcsr();
  _mm_setcsr(usual | 0x8040); /* numbers below the smallest normal one count as 0: they cost a hundred times as much */
#endif
  double log_z = 0.0;
  for (int c = 0; c < d; c++)
    for (int i = 0; i < n; i++) x[(size_t)c * n + i] = (kind == 3 ? 0.0f : par[8 + c]) + (kind == 3 ? par[c] : par[12 + c]) * normal();
  for (int i = 0; i < n; i++) ancestor[i] = i;
  for (int t = 0; t < steps; t++) {
    const float *seen = y + (size_t)t * k;
    if (kind == 0) {
      const float wave = 8.0f * cosf(1.2f * (t + 1)), q = par[0], r = 1.0f / par[1];
      fill(z, n);
      for (int i = 0; i < n; i++) {
        const float a = x[ancestor[i]];
        next[i] = 0.5f * a + 25.0f * a / (1.0f + a * a) + wave + q * z[i];
      }
      for (int i = 0; i < n; i++) { const float e = (seen[0] - next[i] * next[i] * 0.05f) * r; log_w[i] = -0.5f * e * e + par[7]; }
    } else if (kind == 1) {
      const float mu = par[0], rho = par[1], sigma = par[2], square = seen[0] * seen[0];
      fill(z, n);
      for (int i = 0; i < n; i++) next[i] = mu + rho * (x[ancestor[i]] - mu) + sigma * z[i];
      for (int i = 0; i < n; i++) log_w[i] = -0.5f * (square * expf(-next[i]) + next[i]) + par[7];
    } else if (kind == 2) {
      const float dt = par[0], q = par[1], rb = 1.0f / par[2], rr = 1.0f / par[3];
      fill(z, 2 * n);
      for (int c = 0; c < 4; c += 2)
        for (int i = 0; i < n; i++) {
          const int32_t a = ancestor[i];
          const float push = q * z[(size_t)(c / 2) * n + i], speed = x[(size_t)(c + 1) * n + a];
          next[(size_t)c * n + i] = x[(size_t)c * n + a] + dt * speed + 0.5f * dt * dt * push;
          next[(size_t)(c + 1) * n + i] = speed + dt * push;
        }
      for (int i = 0; i < n; i++) {
        const float e = next[i], f = next[(size_t)2 * n + i];
        const float turn = (seen[0] - atan2f(e, f)) * rb, far = (seen[1] - sqrtf(e * e + f * f)) * rr;
        log_w[i] = -0.5f * (turn * turn + far * far) + par[7];
      }
    } else {
      for (int c = 0; c < d; c++) {
        const float *from = x + (size_t)c * n;
        float *to = z + (size_t)c * n, *chance = z + (size_t)(d + c) * n;
        for (int i = 0; i < n; i++) to[i] = from[ancestor[i]];
        fill(chance, n);
      }
      const float *m = stepped + (size_t)t * d * 2 * d;
      if (d == 15)
        product(n, m, z, next, 15);
      else
        product(n, m, z, next, d);
      const float *sd = par + d;
      for (int i = 0; i < n; i++) log_w[i] = par[d + k];
      for (int c = 0; c < k; c++) {
        const float r = 1.0f / sd[c], *p = next + (size_t)(first + c) * n;
        for (int i = 0; i < n; i++) { const float e = (seen[c] - p[i]) * r; log_w[i] -= 0.5f * e * e; }
      }
    }
    log_z += settle(n, log_w, w, ancestor, first_of, ess + t);
    moments(n, d, next, w, mean + (size_t)t * d, variance + (size_t)t * d);
    float *swap = x; x = next; next = swap;
  }
  free(x); free(next); free(log_w); free(w); free(z); free(ancestor); free(first_of);
#ifdef __SSE2__
  _mm_setcsr(usual);
#endif
  return log_z;
}
