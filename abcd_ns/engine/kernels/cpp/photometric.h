// L1 and SSIM (Wang et al. 2004, as pytorch_msssim computes it) of pictures [h, w, 3], with their gradient.
#pragma once
#include <vector>

#include "lanes.h"
#include "threads.h"

namespace photometric {
constexpr int TAPS = 11, REACH = TAPS - 1, MOMENTS = 5;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

struct Bell {
  float tap[TAPS];
  Bell() {
    double total = 0, value[TAPS];
    for (int k = 0; k < TAPS; k++) total += value[k] = std::exp(-(k - 5) * (k - 5) / (2 * 1.5 * 1.5));
    for (int k = 0; k < TAPS; k++) tap[k] = float(value[k] / total);
  }
};
static const Bell bell;

// out[j] = sum over k of tap_k in[j + k step], j < count.
static inline void slide(const float* in, int64_t step, int64_t count, float* out) {
  for (int64_t j = 0; j < count; j++) {
    float total = 0;
    for (int k = 0; k < TAPS; k++) total += bell.tap[k] * in[j + k * step];
    out[j] = total;
  }
}
}  // namespace photometric

// Sums of |x - y| and of 1 - SSIM into sums[2], and the gradient of weights . sums by x. h, w >= 11.
extern "C" void abcd_photometric(const float* x, const float* y, int64_t h, int64_t w, const float* weights,
                                 double* sums, float* gradient) {
  using namespace photometric;
  const int64_t row = 3 * w, inner = 3 * (w - REACH), windows = h - REACH;
  std::vector<float> rows(h * MOMENTS * inner), by(windows * 3 * inner), unlike(windows), apart(h);
  parallel_ranges(h, 4, [&](int64_t begin, int64_t end) {
    std::vector<float> products(3 * row);
    for (int64_t r = begin; r < end; r++) {
      const float *a = x + r * row, *b = y + r * row;
      for (int64_t j = 0; j < row; j++) {
        products[j] = a[j] * a[j], products[row + j] = b[j] * b[j], products[2 * row + j] = a[j] * b[j];
      }
      float* out = &rows[r * MOMENTS * inner];
      slide(a, 3, inner, out), slide(b, 3, inner, out + inner);
      for (int m = 0; m < 3; m++) slide(&products[m * row], 3, inner, out + (2 + m) * inner);
    }
  });
  parallel_ranges(windows, 4, [&](int64_t begin, int64_t end) {
    std::vector<float> blurred(MOMENTS * inner);
    for (int64_t r = begin; r < end; r++) {
      slide(&rows[r * MOMENTS * inner], MOMENTS * inner, MOMENTS * inner, blurred.data());
      const float *m_x = blurred.data(), *m_y = m_x + inner, *m_xx = m_y + inner, *m_yy = m_xx + inner,
                  *m_xy = m_yy + inner;
      float *by_x = &by[r * 3 * inner], *by_xx = by_x + inner, *by_xy = by_xx + inner;
      float total = 0;
      for (int64_t j = 0; j < inner; j++) {
        const float mx = m_x[j], my = m_y[j];
        const float a1 = 2 * mx * my + C1, a2 = 2 * (m_xy[j] - mx * my) + C2;
        const float b1 = mx * mx + my * my + C1, b2 = (m_xx[j] - mx * mx) + (m_yy[j] - my * my) + C2;
        const float per = 1 / (b1 * b2), similarity = a1 * a2 * per;
        const float xy = 2 * a1 * per, xx = -similarity / b2;
        by_xy[j] = xy, by_xx[j] = xx;
        by_x[j] = 2 * my * a2 * per - 2 * mx * similarity / b1 - my * xy - 2 * mx * xx;
        blurred[j] = 1 - similarity;
      }
      for (int64_t j = 0; j < inner; j++) total += blurred[j];
      unlike[r] = total;
    }
  });
  parallel_ranges(h, 4, [&](int64_t begin, int64_t end) {
    // Columns first, into the middle of rows that are zero at both ends; then along rows.
    const int64_t wide = inner + 6 * REACH;
    std::vector<float> padded(3 * wide), spread(3 * row);
    for (int64_t r = begin; r < end; r++) {
      for (int m = 0; m < 3; m++) {
        float* middle = &padded[m * wide + 3 * REACH];
        std::memset(middle, 0, inner * sizeof(float));
        for (int k = 0; k < TAPS; k++) {
          if (r - k < 0 || r - k >= windows) continue;
          const float* from = &by[((r - k) * 3 + m) * inner];
          for (int64_t j = 0; j < inner; j++) middle[j] += bell.tap[k] * from[j];
        }
        slide(&padded[m * wide], 3, row, &spread[m * row]);  // the bell is symmetric
      }
      const float *a = x + r * row, *b = y + r * row, *s_x = spread.data(), *s_xx = s_x + row, *s_xy = s_xx + row;
      float* out = gradient + r * row;
      float total = 0;
      for (int64_t j = 0; j < row; j++) {
        const float difference = a[j] - b[j];
        const float sign = float(difference > 0) - float(difference < 0);
        out[j] = weights[0] * sign - weights[1] * (s_x[j] + 2 * a[j] * s_xx[j] + b[j] * s_xy[j]);
      }
      for (int64_t j = 0; j < row; j++) total += std::fabs(a[j] - b[j]);
      apart[r] = total;
    }
  });
  sums[0] = sums[1] = 0;
  for (float each : apart) sums[0] += each;
  for (float each : unlike) sums[1] += each;
}
