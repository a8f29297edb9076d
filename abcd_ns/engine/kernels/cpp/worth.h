// What a picture says of splits: density/growing.py has the formulas, and the same in torch.
#pragma once
#include <cmath>

#include "projection.h"
#include "threads.h"

// camera: View.numbers. sums: [n, 10]. table: [n, columns], of which 12 are
// added to from `start` on. Gaussians of no weight are passed over.
extern "C" void abcd_worth(int64_t n, const float* means, const float* scales, const float* quats,
                           const float* sums, const float* camera, int64_t axes, float share, float* table,
                           int64_t columns, int64_t start) {
  using projection::EPS, projection::TINY;
  const float *c = camera, fx = c[12], fy = c[13], near = c[21];
  parallel_ranges(n, 1 << 12, [=](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; k++) {
      const float *s = sums + 10 * k, *p = means + 3 * k, *q = quats + 4 * k;
      if (!(s[0] > 0)) continue;
      float at[3], right[3], down[3], xx = EPS, xy = 0, yy = EPS;
      for (int i = 0; i < 3; i++) at[i] = c[3 * i] * p[0] + c[3 * i + 1] * p[1] + c[3 * i + 2] * p[2] + c[9 + i];
      const float z = std::fmax(at[2], near), slope_x = at[0] / z, slope_y = at[1] / z;
      const float per = 1 / std::sqrt(std::fmax(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], TINY));
      const float w = q[0] * per, x = q[1] * per, y = q[2] * per, v = q[3] * per;
      const float turn[9] = {1 - 2 * (y * y + v * v), 2 * (x * y - w * v),     2 * (x * v + w * y),
                             2 * (x * y + w * v),     1 - 2 * (x * x + v * v), 2 * (y * v - w * x),
                             2 * (x * v - w * y),     2 * (y * v + w * x),     1 - 2 * (x * x + y * y)};
      for (int axis = 0; axis < 3; axis++) {
        const float size = std::exp(scales[3 * k + axis]);
        float a[3];
        for (int i = 0; i < 3; i++)
          a[i] = size * (c[3 * i] * turn[axis] + c[3 * i + 1] * turn[3 + axis] + c[3 * i + 2] * turn[6 + axis]);
        right[axis] = (a[0] - slope_x * a[2]) * fx / z, down[axis] = (a[1] - slope_y * a[2]) * fy / z;
        xx += right[axis] * right[axis], xy += right[axis] * down[axis], yy += down[axis] * down[axis];
      }
      const float det = xx * yy - xy * xy, per_area = s[0] * s[0] / (8 * float(M_PI) * std::sqrt(det));
      float found[12] = {}, sum = 0;
      for (int64_t axis = 0; axis < axes; axis++) {
        const float q_x = (yy * right[axis] - xy * down[axis]) / det, q_y = (xx * down[axis] - xy * right[axis]) / det;
        for (int i = 0; i < 3; i++) found[3 * axis + i] = (q_x * s[4 + i] + q_y * s[7 + i]) / share;
        found[9 + axis] = per_area * (q_x * right[axis] + q_y * down[axis]) / share;
      }
      for (float value : found) sum += value;
      if (!std::isfinite(sum)) continue;
      for (int i = 0; i < 12; i++) table[columns * k + start + i] += found[i];
    }
  });
}
