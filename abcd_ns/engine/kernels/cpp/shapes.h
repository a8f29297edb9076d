// What the two primitives are to compositing: alpha at a pixel, and what follows from its gradient.
#pragma once
#include <algorithm>

#include "lanes.h"

namespace drawing {
constexpr float MIN_ALPHA = 1.0f / 255.0f, MAX_ALPHA = 0.999f, MIN_TRANSMITTANCE = 1e-4f;
constexpr float REACH_MARGIN = 0.01f, LOG2_E = 1.44269504f;
constexpr int GSPLAT_TILE = 16, RECORD = 16;  // floats of a record: a line of the cache

// An ellipse on screen, around all fragments, and gsplat's rectangle; which tiles may draw a Gaussian.
struct Bound {
  float x, y, reach, slope, per_precision, flank, per_variance, half_height;
  float left, right;  // of the rectangle
};

static inline float gsplat_first(float mean, float radius) {
  return std::floor(mean / GSPLAT_TILE - radius / GSPLAT_TILE) * GSPLAT_TILE;
}
static inline float gsplat_last(float mean, float radius) {
  return std::ceil(mean / GSPLAT_TILE + radius / GSPLAT_TILE) * GSPLAT_TILE - 1;
}

// min(0.999, opacity 2^-bits) where it is drawn, else 0; fragments with 30 bits are far below MIN_ALPHA.
static inline V alpha_of(V opacity, V bits, I drawn) {
  const V alpha = vmin(opacity * vexp2(-vmin(bits, splat(30))), splat(MAX_ALPHA));
  return only(drawn & (alpha >= splat(MIN_ALPHA)), alpha);
}

// sigma = (a dx^2 + c dy^2) / 2 + b dx dy, with d = mean - pixel. Records hold x, y, z, then a / 2, b and c / 2 in
// bits (times log2 e), opacity and color.
struct Splat {
  static constexpr int ROWS = 14, GRADED = 10, OPACITY = 6, RADIUS = 13;  // of planes
  static constexpr int PARAMETERS = 6, ALPHA = 6, SUMS = 10, COLORS = 6;  // of records and sums
  static constexpr bool IS_SURFEL = false;

  static void record(const float* p, int64_t row, float* r) {
    for (int k = 0; k < 10; k++) r[k] = p[k * row];
    r[3] *= 0.5f * LOG2_E, r[4] *= LOG2_E, r[5] *= 0.5f * LOG2_E;
  }

  static Bound bound(const float* p, int64_t row) {
    const float x = p[0], radius = p[13 * row], xx = p[10 * row], xy = p[11 * row], yy = p[12 * row];
    const float reach = 2 * std::log(std::max(p[6 * row] / MIN_ALPHA, 1.0f)) + REACH_MARGIN;
    return {x, p[row], reach, xy / yy, 1 / p[3 * row], xy * std::sqrt(reach / xx), 1 / yy,
            std::sqrt(reach * yy), gsplat_first(x, radius), gsplat_last(x, radius)};
  }

  // Parameters are numbers and dx, dy vectors over pixels; or all are vectors over Gaussians.
  template <class T>
  static V alpha(const T* r, V dx, V dy) {
    const V bits = dx * (r[3] * dx + r[4] * dy) + r[5] * dy * dy;
    return alpha_of(splat(0) + r[6], bits, bits >= splat(0));
  }

  // Adds what a pixel gives, with s = dL/dsigma, to the sums of a few Gaussians.
  static void add(const V* r, V dx, V dy, V s, V* sums) {
    const V s_dx = s * dx, s_dy = s * dy;
    sums[0] += s, sums[1] += s_dx, sums[2] += s_dy;
    sums[3] += s_dx * dx, sums[4] += s_dx * dy, sums[5] += s_dy * dy;
  }

  // Adds the absolute gradient of the middle that a pixel gives, as gsplat's absgrad.
  static void add_absolute(const V* r, V dx, V dy, V s, V* sums) {
    const V x = s * (2 * r[3] * dx + r[4] * dy), y = s * (r[4] * dx + 2 * r[5] * dy);
    sums[0] += vmax(x, -x) / LOG2_E, sums[1] += vmax(y, -y) / LOG2_E;
  }

  static void to_rows(const float* r, const float* p, int64_t row, const float* s, float* g) {
    const float a = p[3 * row], b = p[4 * row], c = p[5 * row];
    g[0] = a * s[1] + b * s[2], g[1] = b * s[1] + c * s[2], g[2] = s[9];
    g[3] = 0.5f * s[3], g[4] = s[4], g[5] = 0.5f * s[5], g[6] = -s[0] / r[6];
    g[7] = s[6], g[8] = s[7], g[9] = s[8];
  }
};

// sigma = min((s^2 + t^2) / 2, ex^2 + ey^2), with e = the box's middle - pixel, d = the disc's middle - pixel,
// w = W - dx Wx - dy Wy, s = (B dy - D dx) / w, t = (C dx - A dy) / w; the matrix counts from the disc's middle.
// Records hold u, v, z, e - d, A, B, C, D, W, Wx, Wy, opacity and color.
struct Surfel {
  static constexpr int ROWS = 19, GRADED = 15, OPACITY = 11, RADIUS = 18;
  static constexpr int PARAMETERS = 12, ALPHA = 12, SUMS = 16, COLORS = 12;
  static constexpr bool IS_SURFEL = true;

  static void relative(const float* p, int64_t row, float* m) {  // a b c d e f
    const float u = p[3 * row], v = p[4 * row], e = p[9 * row], f = p[10 * row];
    m[0] = p[5 * row] - u * e, m[1] = p[6 * row] - u * f, m[2] = p[7 * row] - v * e, m[3] = p[8 * row] - v * f;
    m[4] = e, m[5] = f;
  }

  static void record(const float* p, int64_t row, float* r) {
    float m[6];
    relative(p, row, m);
    r[0] = p[3 * row], r[1] = p[4 * row], r[2] = p[2 * row];
    r[3] = p[0] - r[0], r[4] = p[row] - r[1];
    for (int k = 0; k < 4; k++) r[5 + k] = m[k], r[12 + k] = p[(11 + k) * row];
    r[9] = m[0] * m[3] - m[1] * m[2], r[10] = m[5] * m[2] - m[4] * m[3], r[11] = m[4] * m[1] - m[5] * m[0];
  }

  // Alpha reaches 1/255 where s^2 + t^2 is at most k, which is an ellipse on screen, or in a circle of radius
  // sqrt(k / 2) around the box's middle. An ellipse around both: the disc's, with the square of the circle's
  // reach from its middle added to both variances. A disc that crosses the camera's plane has no ellipse.
  static Bound bound(const float* p, int64_t row) {
    float m[6];
    relative(p, row, m);
    const float x = p[0], y = p[row], radius = p[18 * row];
    const float k = 2 * std::log(std::max(p[11 * row] / MIN_ALPHA, 1.0f)) + REACH_MARGIN;
    const float distance = k * (m[4] * m[4] + m[5] * m[5]) - 1;
    if (!(distance < -0.01f)) {
      const float around = 2 * (radius + GSPLAT_TILE);
      const float square = around * around;
      return {x, y, 1, 0, square, 0, 1 / square, around, gsplat_first(x, radius), gsplat_last(x, radius)};
    }
    const float per = 1 / distance, scale = k * per;
    const float off_x = scale * (m[0] * m[4] + m[1] * m[5]), off_y = scale * (m[2] * m[4] + m[3] * m[5]);
    const float mid_x = p[3 * row] + off_x, mid_y = p[4 * row] + off_y;
    const float side = std::sqrt(0.5f * k) + std::hypot(mid_x - x, mid_y - y), margin = side * side;
    float xx = off_x * off_x - scale * (m[0] * m[0] + m[1] * m[1]);
    float yy = off_y * off_y - scale * (m[2] * m[2] + m[3] * m[3]);
    const float xy = off_x * off_y - scale * (m[0] * m[2] + m[1] * m[3]);
    const float area = (m[0] * m[3] - m[1] * m[2]) * scale;
    const float det = -area * area * per + margin * (xx + yy) + margin * margin;  // without cancellation
    xx += margin, yy += margin;
    return {mid_x, mid_y, 1, xy / yy, det / yy, xy / std::sqrt(xx), 1 / yy, std::sqrt(yy),
            gsplat_first(x, radius), gsplat_last(x, radius)};
  }

  template <class T>
  static void meet(const T* r, V dx, V dy, V& s, V& t, V& inverse, I& meets) {
    const V w = r[9] - dx * r[10] - dy * r[11];
    meets = w != splat(0);
    inverse = 1 / (meets ? w : splat(1));
    s = (r[6] * dy - r[8] * dx) * inverse, t = (r[7] * dx - r[5] * dy) * inverse;
  }

  template <class T>
  static V alpha(const T* r, V dx, V dy) {
    V s, t, inverse;
    I meets;
    meet(r, dx, dy, s, t, inverse, meets);
    const V on_disc = 0.5f * (s * s + t * t), ex = dx + r[3], ey = dy + r[4];
    return alpha_of(splat(0) + r[12], LOG2_E * vmin(on_disc, ex * ex + ey * ey), meets);
  }

  static void add(const V* r, V dx, V dy, V g, V* sums) {
    V s, t, inverse;
    I meets;
    meet(r, dx, dy, s, t, inverse, meets);
    const V ex = dx + r[3], ey = dy + r[4];
    const I disc = 0.5f * (s * s + t * t) <= ex * ex + ey * ey;
    const V p = only(disc, g * s * inverse), q = only(disc, g * t * inverse), k = only(disc, -(p * s + q * t));
    const V filtered = only(~disc, 2 * g);
    sums[0] += g, sums[1] += p, sums[2] += p * dx, sums[3] += p * dy, sums[4] += q, sums[5] += q * dx;
    sums[6] += q * dy, sums[7] += k, sums[8] += k * dx, sums[9] += k * dy;
    sums[10] += filtered * ex, sums[11] += filtered * ey;
  }

  static void to_rows(const float* r, const float* planes, int64_t row, const float* s, float* g) {
    float m[6];
    relative(planes, row, m);
    const float a = m[0], b = m[1], c = m[2], d = m[3], e = m[4], f = m[5];
    const float u = planes[3 * row], v = planes[4 * row];
    const float w = s[7], w_x = -s[8], w_y = -s[9];
    const float by_a = -s[6] + w * d - w_y * f, by_b = s[3] - w * c + w_y * e;
    const float by_c = s[5] - w * b + w_x * f, by_d = -s[2] + w * a - w_x * e;
    const float middle_x = c * s[4] - d * s[1] - r[10] * s[7] + s[10];
    const float middle_y = b * s[1] - a * s[4] - r[11] * s[7] + s[11];
    g[0] = s[10], g[1] = s[11], g[2] = s[15];
    g[3] = middle_x - s[10] - by_a * e - by_b * f, g[4] = middle_y - s[11] - by_c * e - by_d * f;
    g[5] = by_a, g[6] = by_b, g[7] = by_c, g[8] = by_d;
    g[9] = w_y * b - w_x * d - u * by_a - v * by_c, g[10] = w_x * c - w_y * a - u * by_b - v * by_d;
    g[11] = -s[0] / r[12], g[12] = s[12], g[13] = s[13], g[14] = s[14];
  }
};
}  // namespace drawing
