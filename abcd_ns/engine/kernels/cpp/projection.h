// Gaussians as cameras see them, and the gradient by hand. The torch functions of render/splat_kernels.py are
// the reference; names are theirs.
#pragma once
#include <vector>

#include "lanes.h"
#include "threads.h"

namespace projection {
constexpr int BASES = 15, REST = 3 * BASES, CAMERA = 26;
constexpr float FAR_PLANE = 1e10f, EPS = 0.3f, MAX_RADIUS = 16777216.0f, TINY = 1e-24f;
constexpr float SH_C0 = 0.28209479177387814f, C1 = 0.4886025119029199f, C2 = 1.0925484305920792f,
                C2_ZZ = 0.31539156525252005f, C3_A = 0.5900435899266435f, C3_B = 2.890611442640554f,
                C3_C = 0.4570457994644658f, C3_ZZZ = 0.3731763325901154f;
constexpr int64_t AT_ONCE = 512;

struct Parameters {
  float *means, *scales, *quats, *dc, *rest, *opacities;
  int64_t n, coefficients;  // of harmonics of degrees 1 and up: 0, 3, 8 or 15
};

struct Camera {
  float r[9], t[3], fx, fy, cx, cy, width, height, antialiased, center[3], near, degrees[3];
};
static_assert(sizeof(Camera) == CAMERA * sizeof(float), "as render/projection.py lays it out");

static inline int bases_in_use(const Camera& c, int64_t coefficients) {
  const int used = c.degrees[2] > 0 ? 15 : c.degrees[1] > 0 ? 8 : c.degrees[0] > 0 ? 3 : 0;
  return used < coefficients ? used : int(coefficients);
}

// What all cameras share of a few Gaussians.
struct Few {
  V mean[3], deviation[3], quat[4], per_quat, rotation[9], dc[3], rest[REST], sigmoid;

  Few(const Parameters& p, int64_t first, int valid, bool is_surfel, int bases) {
    load_rows<3>(p.means + 3 * first, valid, mean);
    load_rows<3>(p.scales + 3 * first, valid, deviation);
    for (int k = 0; k < 3; k++) deviation[k] = is_surfel && k == 2 ? splat(1) : vexp(deviation[k]);
    load_rows<4>(p.quats + 4 * first, valid, quat);
    V& w = quat[0];
    V &x = quat[1], &y = quat[2], &z = quat[3];
    per_quat = 1 / vsqrt(vmax(w * w + x * x + y * y + z * z, splat(TINY)));
    for (V& q : quat) q *= per_quat;
    const V turned[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    for (int k = 0; k < 9; k++) rotation[k] = turned[k];
    load_rows<3>(p.dc + 3 * first, valid, dc);
    if (bases == 15)
      load_rows<45>(p.rest + 3 * p.coefficients * first, valid, rest);
    else if (bases > 0 && p.coefficients == 15) {
      V all[REST];
      load_rows<45>(p.rest + 45 * first, valid, all);
      for (int k = 0; k < 3 * bases; k++) rest[k] = all[k];
    } else if (bases > 0 && p.coefficients == 8)
      load_rows<24>(p.rest + 24 * first, valid, rest);
    else if (bases > 0)
      load_rows<9>(p.rest + 9 * first, valid, rest);
    V logit;
    load_rows<1>(p.opacities + first, valid, &logit);
    sigmoid = 1 / (1 + vexp(-logit));
  }
};

// A point before one camera, and its axes.
struct Seen {
  V m[3], inverse, u, v, slope_x, slope_y, away[3], per_length, axis[3][3];  // axis[k]: camera space
  I in_front;

  Seen(const Few& few, const Camera& c, int axes) {
    for (int i = 0; i < 3; i++) {
      m[i] = c.r[3 * i] * few.mean[0] + c.r[3 * i + 1] * few.mean[1] + c.r[3 * i + 2] * few.mean[2] + c.t[i];
      away[i] = few.mean[i] - c.center[i];
    }
    in_front = m[2] >= splat(c.near);
    inverse = 1 / (in_front ? m[2] : splat(1));
    slope_x = m[0] * inverse, slope_y = m[1] * inverse;
    u = c.fx * slope_x + c.cx, v = c.fy * slope_y + c.cy;
    per_length = 1 / vsqrt(vmax(away[0] * away[0] + away[1] * away[1] + away[2] * away[2], splat(TINY)));
    for (int k = 0; k < axes; k++)
      for (int i = 0; i < 3; i++)
        axis[k][i] = (c.r[3 * i] * few.rotation[k] + c.r[3 * i + 1] * few.rotation[3 + k] +
                      c.r[3 * i + 2] * few.rotation[6 + k]) *
                     few.deviation[k];
  }
};

static inline void harmonics(const V* d, V* b) {
  const V x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z, ring = C3_C * (5 * zz - 1);
  b[0] = -C1 * y, b[1] = C1 * z, b[2] = -C1 * x;
  b[3] = C2 * x * y, b[4] = -C2 * y * z, b[5] = C2_ZZ * (3 * zz - 1), b[6] = -C2 * x * z;
  b[7] = 0.5f * C2 * (xx - yy), b[8] = -C3_A * y * (3 * xx - yy), b[9] = C3_B * x * y * z, b[10] = -ring * y;
  b[11] = C3_ZZZ * z * (5 * zz - 3), b[12] = -ring * x, b[13] = 0.5f * C3_B * z * (xx - yy);
  b[14] = -C3_A * x * (xx - 3 * yy);
}

// Before the clamp at 0.
static inline void colors_of(const Few& few, const Seen& seen, int bases, V* color, V* direction, V* basis) {
  for (int i = 0; i < 3; i++) direction[i] = seen.away[i] * seen.per_length;
  for (int c = 0; c < 3; c++) color[c] = SH_C0 * few.dc[c] + 0.5f;
  if (!bases) return;
  harmonics(direction, basis);
  for (int k = 0; k < bases; k++)
    for (int c = 0; c < 3; c++) color[c] += basis[k] * few.rest[3 * k + c];
}

static inline V radius_of(V x, V y, V half, I drawn, const Camera& c) {
  const V radius = vceil(3 * half);
  drawn = drawn & (x + radius > 0) & (x - radius < splat(c.width));
  drawn = drawn & (y + radius > 0) & (y - radius < splat(c.height));
  return only(drawn, vmin(radius, splat(MAX_RADIUS)));
}

struct Splat {
  static constexpr int AXES = 3, GRADED = 10, ROWS = 14;
  static constexpr bool IS_SURFEL = false;
  V across[3], down[3], slope_x, slope_y, xx, xy, yy, sharp, det;
  I free_x, free_y;

  Splat(const Seen& s, const Camera& c) {
    const float margin_x = 0.15f * c.width / c.fx, margin_y = 0.15f * c.height / c.fy;
    const V low_x = splat(-c.cx / c.fx - margin_x), high_x = splat((c.width - c.cx) / c.fx + margin_x);
    const V low_y = splat(-c.cy / c.fy - margin_y), high_y = splat((c.height - c.cy) / c.fy + margin_y);
    slope_x = vmin(vmax(s.slope_x, low_x), high_x), slope_y = vmin(vmax(s.slope_y, low_y), high_y);
    free_x = slope_x == s.slope_x, free_y = slope_y == s.slope_y;
    xx = xy = yy = splat(0);
    for (int k = 0; k < 3; k++) {
      across[k] = c.fx * s.inverse * (s.axis[k][0] - slope_x * s.axis[k][2]);
      down[k] = c.fy * s.inverse * (s.axis[k][1] - slope_y * s.axis[k][2]);
      xx += across[k] * across[k], xy += across[k] * down[k], yy += down[k] * down[k];
    }
    sharp = splat(0);
    for (int k = 0; k < 3; k++) {
      const int i = (k + 1) % 3, j = (k + 2) % 3;
      const V normal = across[i] * down[j] - across[j] * down[i];
      sharp += normal * normal;
    }
    det = sharp + EPS * (xx + yy) + EPS * EPS;
  }

  V compensation(const Camera& c) const { return c.antialiased > 0 ? vsqrt(sharp / det) : splat(1); }

  void rows(const Few& few, const Seen& s, const Camera& c, const V* color, V* out) const {
    const V a = xx + EPS, d = yy + EPS, mid = 0.5f * (a + d);
    out[0] = s.u, out[1] = s.v, out[2] = s.m[2], out[3] = d / det, out[4] = -xy / det, out[5] = a / det;
    out[6] = few.sigmoid * compensation(c);
    for (int k = 0; k < 3; k++) out[7 + k] = vmax(color[k], splat(0));
    out[10] = a, out[11] = xy, out[12] = d;
    const V half = vsqrt(mid + vsqrt(vmax(mid * mid - det, splat(0.01f))));
    out[13] = radius_of(s.u, s.v, half, s.in_front & (s.m[2] <= splat(FAR_PLANE)) & (det > 0), c);
  }

  // From the gradient g of the GRADED rows those of u, v, the slopes, 1/z, the axes and the sigmoid.
  void back(const Few& few, const Seen& s, const Camera& c, const V* g, V* by_slope, V& by_inverse,
            V (*by_axis)[3], V& by_sigmoid) const {
    by_slope[0] = c.fx * g[0], by_slope[1] = c.fy * g[1];
    const V p = (yy + EPS) / det, q = -xy / det, r = (xx + EPS) / det, half = 0.5f * g[4];
    // -Q G Q, of symmetric matrices Q (the inverse) and G.
    const V i = g[3] * p + half * q, j = g[3] * q + half * r, k = half * p + g[5] * q, l = half * q + g[5] * r;
    V by_xx = -(p * i + q * k), by_xy = -2 * (p * j + q * l), by_yy = -(q * j + r * l);
    by_sigmoid = g[6];
    if (c.antialiased > 0) {
      const V factor = compensation(c);
      const V h = only(sharp > 0, 0.5f * g[6] * few.sigmoid / factor);
      const V by_sharp = h * (det - sharp) / (det * det), by_blur = -h * sharp / (det * det) * EPS;
      by_xx += by_sharp * yy + by_blur, by_yy += by_sharp * xx + by_blur, by_xy -= 2 * xy * by_sharp;
      by_sigmoid *= factor;
    }
    V x = splat(0), y = splat(0);
    by_inverse = splat(0);
    for (int a = 0; a < 3; a++) {
      const V by_across = 2 * across[a] * by_xx + down[a] * by_xy;
      const V by_down = 2 * down[a] * by_yy + across[a] * by_xy;
      const V along = c.fx * s.inverse * by_across, up = c.fy * s.inverse * by_down;
      by_axis[a][0] = along, by_axis[a][1] = up, by_axis[a][2] = -slope_x * along - slope_y * up;
      x -= s.axis[a][2] * along, y -= s.axis[a][2] * up;
      by_inverse += (by_across * across[a] + by_down * down[a]) / s.inverse;
    }
    by_slope[0] += only(free_x, x), by_slope[1] += only(free_y, y);
  }
};

struct Surfel {
  static constexpr int AXES = 2, GRADED = 15, ROWS = 19;
  static constexpr bool IS_SURFEL = true;
  V a[2], c_[2], away[2], distance, per, off_x, off_y;

  Surfel(const Seen& s, const Camera& c) {
    for (int k = 0; k < 2; k++) {
      away[k] = s.axis[k][2] * s.inverse;
      a[k] = c.fx * (s.axis[k][0] * s.inverse - s.slope_x * away[k]);
      c_[k] = c.fy * (s.axis[k][1] * s.inverse - s.slope_y * away[k]);
    }
    distance = away[0] * away[0] + away[1] * away[1] - 1;
    per = 1 / (distance == 0 ? splat(1) : distance);
    off_x = (a[0] * away[0] + a[1] * away[1]) * per, off_y = (c_[0] * away[0] + c_[1] * away[1]) * per;
  }

  void rows(const Few& few, const Seen& s, const Camera& c, const V* color, V* out) const {
    out[0] = s.u + off_x, out[1] = s.v + off_y, out[2] = s.m[2], out[3] = s.u, out[4] = s.v;
    for (int k = 0; k < 2; k++)
      out[5 + k] = a[k] + s.u * away[k], out[7 + k] = c_[k] + s.v * away[k], out[9 + k] = away[k];
    out[11] = few.sigmoid;
    for (int k = 0; k < 3; k++) out[12 + k] = vmax(color[k], splat(0)), out[15 + k] = splat(0);
    const V x = off_x * off_x - (a[0] * a[0] + a[1] * a[1]) * per;
    const V y = off_y * off_y - (c_[0] * c_[0] + c_[1] * c_[1]) * per;
    const I drawn = s.in_front & (s.m[2] <= splat(FAR_PLANE)) & (distance != 0);
    out[18] = radius_of(out[0], out[1], vsqrt(vmax(vmax(x, y), splat(1e-4f))), drawn, c);
  }

  void back(const Few&, const Seen& s, const Camera& c, const V* g, V* by_slope, V& by_inverse, V (*by_axis)[3],
            V& by_sigmoid) const {
    by_sigmoid = g[11];
    V by_u = g[0] + g[3], by_v = g[1] + g[4], by_per = splat(0);
    for (int k = 0; k < 2; k++) {
      by_u += g[5 + k] * away[k], by_v += g[7 + k] * away[k];
      by_per += a[k] * away[k] * g[0] + c_[k] * away[k] * g[1];
    }
    by_slope[0] = c.fx * by_u, by_slope[1] = c.fy * by_v, by_inverse = splat(0);
    const V by_distance = -per * per * by_per;
    for (int k = 0; k < 2; k++) {
      const V by_a = g[5 + k] + per * away[k] * g[0], by_c = g[7 + k] + per * away[k] * g[1];
      V by_away = g[9 + k] + s.u * g[5 + k] + s.v * g[7 + k] + per * (a[k] * g[0] + c_[k] * g[1]);
      by_away += 2 * away[k] * by_distance - c.fx * s.slope_x * by_a - c.fy * s.slope_y * by_c;
      by_slope[0] -= c.fx * away[k] * by_a, by_slope[1] -= c.fy * away[k] * by_c;
      const V by[3] = {c.fx * by_a, c.fy * by_c, by_away};
      for (int i = 0; i < 3; i++) by_axis[k][i] = by[i] * s.inverse, by_inverse += by[i] * s.axis[k][i];
    }
  }
};

template <class Kind>
static void project(const Parameters& p, const Camera* cameras, int64_t views, float* planes) {
  int bases = 0;
  for (int64_t v = 0; v < views; v++) bases = std::max(bases, bases_in_use(cameras[v], p.coefficients));
  parallel_ranges(p.n, AT_ONCE, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += LANES) {
      const int valid = int(std::min<int64_t>(LANES, end - i));
      const Few few(p, i, valid, Kind::IS_SURFEL, bases);
      for (int64_t v = 0; v < views; v++) {
        const Seen seen(few, cameras[v], Kind::AXES);
        V color[3], direction[3], basis[BASES], rows[Kind::ROWS];
        colors_of(few, seen, bases_in_use(cameras[v], p.coefficients), color, direction, basis);
        Kind(seen, cameras[v]).rows(few, seen, cameras[v], color, rows);
        float* out = planes + v * Kind::ROWS * p.n + i;
        if (valid == LANES)
          for (int k = 0; k < Kind::ROWS; k++) store(out + k * p.n, rows[k]);
        else
          for (int k = 0; k < Kind::ROWS; k++)
            for (int l = 0; l < valid; l++) out[k * p.n + l] = rows[k][l];
      }
    }
  });
}

// Gradients of the color by rest and dc are added up; that of the direction is put into by_mean.
static inline void colors_back(const Few& few, const Seen& seen, int bases, const V* g, V* by_dc, V* by_rest,
                               V* by_mean) {
  V color[3], d[3], b[BASES], by[3];
  colors_of(few, seen, bases, color, d, b);
  for (int c = 0; c < 3; c++) by[c] = only(color[c] >= splat(0), g[c]), by_dc[c] += SH_C0 * by[c];
  if (!bases) return;
  V h[BASES];
  for (int k = 0; k < BASES; k++) h[k] = splat(0);
  for (int k = 0; k < bases; k++)
    for (int c = 0; c < 3; c++) by_rest[3 * k + c] += b[k] * by[c], h[k] += by[c] * few.rest[3 * k + c];
  const V x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z, ring = C3_C * (5 * zz - 1);
  const V by_x = -C1 * h[2] + C2 * (y * h[3] - z * h[6] + x * h[7]) - 6 * C3_A * x * y * h[8] +
                 C3_B * (y * z * h[9] + x * z * h[13]) - ring * h[12] - 3 * C3_A * (xx - yy) * h[14];
  const V by_y = -C1 * h[0] + C2 * (x * h[3] - z * h[4] - y * h[7]) - 3 * C3_A * (xx - yy) * h[8] +
                 C3_B * (x * z * h[9] - y * z * h[13]) - ring * h[10] + 6 * C3_A * x * y * h[14];
  const V by_z = C1 * h[1] - C2 * (y * h[4] + x * h[6]) + 6 * C2_ZZ * z * h[5] +
                 C3_B * (x * y * h[9] + 0.5f * (xx - yy) * h[13]) - 10 * C3_C * z * (y * h[10] + x * h[12]) +
                 C3_ZZZ * (15 * zz - 3) * h[11];
  const V along = x * by_x + y * by_y + z * by_z;
  by_mean[0] += (by_x - x * along) * seen.per_length;
  by_mean[1] += (by_y - y * along) * seen.per_length;
  by_mean[2] += (by_z - z * along) * seen.per_length;
}

template <class Kind>
static void project_back(const Parameters& p, const Camera* cameras, int64_t views, const float* grads,
                         const Parameters& out) {
  int bases = 0;
  for (int64_t v = 0; v < views; v++) bases = std::max(bases, bases_in_use(cameras[v], p.coefficients));
  parallel_ranges(p.n, AT_ONCE, [&](int64_t begin, int64_t end) {
    const int64_t k = p.coefficients;
    std::memset(out.means + 3 * begin, 0, 12 * (end - begin)), std::memset(out.scales + 3 * begin, 0, 12 * (end - begin));
    std::memset(out.quats + 4 * begin, 0, 16 * (end - begin)), std::memset(out.dc + 3 * begin, 0, 12 * (end - begin));
    std::memset(out.rest + 3 * k * begin, 0, 12 * k * (end - begin));
    std::memset(out.opacities + begin, 0, 4 * (end - begin));
    std::vector<V> g(views * Kind::GRADED);
    std::vector<char> has(views);
    for (int64_t i = begin; i < end; i += LANES) {
      const int valid = int(std::min<int64_t>(LANES, end - i));
      bool found = false;
      for (int64_t v = 0; v < views; v++) {
        const float* from = grads + v * Kind::ROWS * p.n + i;
        I some = I{};
        for (int r = 0; r < Kind::GRADED; r++) {
          V row = splat(0);
          if (valid == LANES) row = load(from + r * p.n);
          else
            for (int l = 0; l < valid; l++) row[l] = from[r * p.n + l];
          g[v * Kind::GRADED + r] = row, some |= row != splat(0);
        }
        found |= has[v] = any(some);
      }
      if (!found) continue;
      const Few few(p, i, valid, Kind::IS_SURFEL, bases);
      V by_mean[3] = {}, by_scale[3] = {}, by_turn[9] = {}, by_dc[3] = {}, by_rest[REST] = {}, by_logit = {};
      for (int64_t v = 0; v < views; v++) {
        if (!has[v]) continue;
        const Camera& c = cameras[v];
        const V* rows = &g[v * Kind::GRADED];
        const Seen seen(few, c, Kind::AXES);
        V by_slope[2], by_inverse, by_axis[3][3], by_sigmoid;
        Kind(seen, c).back(few, seen, c, rows, by_slope, by_inverse, by_axis, by_sigmoid);
        colors_back(few, seen, bases_in_use(c, k), rows + Kind::GRADED - 3, by_dc, by_rest, by_mean);
        by_logit += by_sigmoid * few.sigmoid * (1 - few.sigmoid);
        by_inverse += by_slope[0] * seen.m[0] + by_slope[1] * seen.m[1];
        const V by_z = rows[2] - only(seen.in_front, seen.inverse * seen.inverse * by_inverse);
        const V by[3] = {by_slope[0] * seen.inverse, by_slope[1] * seen.inverse, by_z};
        for (int a = 0; a < Kind::AXES; a++)
          for (int j = 0; j < 3; j++) {
            by_scale[a] += by_axis[a][j] * seen.axis[a][j];
            by_turn[3 * j + a] += few.deviation[a] * (c.r[j] * by_axis[a][0] + c.r[3 + j] * by_axis[a][1] +
                                                      c.r[6 + j] * by_axis[a][2]);
          }
        for (int j = 0; j < 3; j++) by_mean[j] += c.r[j] * by[0] + c.r[3 + j] * by[1] + c.r[6 + j] * by[2];
      }
      if (Kind::IS_SURFEL) by_scale[2] = splat(0);
      const V *q = few.quat, *d = by_turn, w = q[0], x = q[1], y = q[2], z = q[3];
      V by_quat[4] = {2 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
                      2 * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - 2 * x * (d[4] + d[8])),
                      2 * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - 2 * y * (d[0] + d[8])),
                      2 * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - 2 * z * (d[0] + d[4]))};
      const V along = by_quat[0] * w + by_quat[1] * x + by_quat[2] * y + by_quat[3] * z;
      for (int j = 0; j < 4; j++) by_quat[j] = (by_quat[j] - q[j] * along) * few.per_quat;
      store_rows<3>(by_mean, valid, out.means + 3 * i), store_rows<3>(by_scale, valid, out.scales + 3 * i);
      store_rows<4>(by_quat, valid, out.quats + 4 * i), store_rows<3>(by_dc, valid, out.dc + 3 * i);
      store_rows<1>(&by_logit, valid, out.opacities + i);
      if (k == 15) store_rows<45>(by_rest, valid, out.rest + 45 * i);
      else if (k == 8) store_rows<24>(by_rest, valid, out.rest + 24 * i);
      else if (k == 3) store_rows<9>(by_rest, valid, out.rest + 9 * i);
    }
  });
}
}  // namespace projection

extern "C" void abcd_project(int is_surfel, const projection::Parameters* p, const projection::Camera* cameras,
                             int64_t views, float* planes) {
  if (is_surfel) projection::project<projection::Surfel>(*p, cameras, views, planes);
  else projection::project<projection::Splat>(*p, cameras, views, planes);
}

// Writes all of `out`: the sums over views.
extern "C" void abcd_project_back(int is_surfel, const projection::Parameters* p,
                                  const projection::Camera* cameras, int64_t views, const float* grads,
                                  const projection::Parameters* out) {
  if (is_surfel) projection::project_back<projection::Surfel>(*p, cameras, views, grads, *out);
  else projection::project_back<projection::Splat>(*p, cameras, views, grads, *out);
}
