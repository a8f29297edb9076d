// L1 and SSIM (Wang et al. 2004, as pytorch_msssim computes it) of pictures [h, w, 3], with their gradient.
#pragma once
#include <memory>
#include <vector>

#include "lanes.h"
#include "threads.h"

namespace photometric {
constexpr int TAPS = 11, REACH = TAPS - 1, MOMENTS = 5, STRIDE = 2;
constexpr int SPREAD = REACH / STRIDE;  // one less than the rows of windows that a row of pixels is in, at most
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

// Along a row of pixels [count], 3 channels each: out[j] = sum over k of tap_k in[j + 3 k].
static inline void slide(const float* in, int64_t count, float* __restrict out) {
  const Bell b = bell;
  for (int64_t j = 0; j < count; j++) {
    float total = 0;
    for (int k = 0; k < TAPS; k++) total += b.tap[k] * in[j + 3 * k];
    out[j] = total;
  }
}

// What the rows of windows [SPREAD + 1, count] that hold row r of the pixels say of it; the bell is symmetric.
static inline void gather(const float* in, int64_t r, int64_t count, float* __restrict out) {
  float tap[SPREAD + 1];
  for (int k = 0; k <= SPREAD; k++) {
    const int64_t at = r % STRIDE + STRIDE * k;
    tap[k] = at < TAPS ? bell.tap[at] : 0;
  }
  for (int64_t j = 0; j < count; j++) {
    float total = 0;
    for (int k = 0; k <= SPREAD; k++) total += tap[k] * in[j + (SPREAD - k) * count];
    out[j] = total;
  }
}

static inline float sum(const float* in, int64_t count) {
  V sums{};
  int64_t j = 0;
  for (; j + LANES <= count; j += LANES) sums += load(in + j);
  float total = 0;
  for (int l = 0; l < LANES; l++) total += sums[l];
  for (; j < count; j++) total += in[j];
  return total;
}

// The same down the columns of x, y, x x, y y and x y, from one row on: [MOMENTS, row].
static inline void blur_down(const float* x, const float* y, int64_t row, float* __restrict out) {
  const Bell b = bell;
#pragma GCC ivdep
  for (int64_t j = 0; j < row; j++) {
    float m_x = 0, m_y = 0, m_xx = 0, m_yy = 0, m_xy = 0;
    for (int k = 0; k < TAPS; k++) {
      const float p = x[j + k * row], q = y[j + k * row], tp = b.tap[k] * p, tq = b.tap[k] * q;
      m_x += tp, m_y += tq, m_xx += tp * p, m_yy += tq * q, m_xy += tp * q;
    }
    out[j] = m_x, out[row + j] = m_y, out[2 * row + j] = m_xx, out[3 * row + j] = m_yy, out[4 * row + j] = m_xy;
  }
}

// The sum of 1 - SSIM over windows of these moments [MOMENTS, count], and by[m wide + j]: its derivatives,
// negative, by the means of x, x x and x y.
static inline float dissimilarity(float* moments, int64_t count, int64_t wide, float* __restrict by) {
#pragma GCC ivdep
  for (int64_t j = 0; j < count; j++) {
    const float mx = moments[j], my = moments[count + j];
    const float a1 = 2 * mx * my + C1, a2 = 2 * (moments[4 * count + j] - mx * my) + C2;
    const float b1 = mx * mx + my * my + C1;
    const float b2 = (moments[2 * count + j] - mx * mx) + (moments[3 * count + j] - my * my) + C2;
    const float per = 1 / (b1 * b2), similarity = a1 * a2 * per;
    const float xy = 2 * a1 * per, xx = -similarity / b2;
    by[j] = 2 * my * a2 * per - 2 * mx * similarity / b1 - my * xy - 2 * mx * xx;
    by[wide + j] = xx, by[2 * wide + j] = xy, moments[j] = 1 - similarity;
  }
  return sum(moments, count);
}
}  // namespace photometric

// Sums of |x - y| and of 1 - SSIM into sums[2], and the gradient of weights . sums by x. h, w >= 11.
// Every other row of windows counts, for its share of all of them.
extern "C" void abcd_photometric(const float* x, const float* y, int64_t h, int64_t w, const float* weights,
                                 double* sums, float* gradient) {
  using namespace photometric;
  const int64_t row = 3 * w, inner = 3 * (w - REACH), windows = (h - REACH + STRIDE - 1) / STRIDE;
  const float share = float(h - REACH) / windows;
  // Derivatives by what a row of windows sees, spread along it, between rows of zeros.
  std::unique_ptr<float[]> spread(new float[(windows + 2 * SPREAD) * 3 * row]);
  std::memset(&spread[0], 0, SPREAD * 3 * row * sizeof(float));
  std::memset(&spread[(windows + SPREAD) * 3 * row], 0, SPREAD * 3 * row * sizeof(float));
  std::vector<float> unlike(windows), apart(h);
  parallel_ranges(windows, 4, [&](int64_t begin, int64_t end) {
    const int64_t wide = inner + 6 * REACH;  // a window's derivatives, in zeros
    std::vector<float> down(MOMENTS * row), moments(MOMENTS * inner), by(3 * wide);
    for (int64_t r = begin; r < end; r++) {
      blur_down(x + STRIDE * r * row, y + STRIDE * r * row, row, down.data());
      for (int m = 0; m < MOMENTS; m++) slide(&down[m * row], inner, &moments[m * inner]);
      unlike[r] = dissimilarity(moments.data(), inner, wide, &by[3 * REACH]);
      for (int m = 0; m < 3; m++) slide(&by[m * wide], row, &spread[((r + SPREAD) * 3 + m) * row]);
    }
  });
  parallel_ranges(h, 4, [&](int64_t begin, int64_t end) {
    std::vector<float> by(3 * row);
    for (int64_t r = begin; r < end; r++) {
      gather(&spread[r / STRIDE * 3 * row], r, 3 * row, by.data());
      const float *a = x + r * row, *b = y + r * row, *by_xx = &by[row], *by_xy = &by[2 * row];
      float *by_x = by.data(), *out = gradient + r * row;
#pragma GCC ivdep
      for (int64_t j = 0; j < row; j++) {
        const float difference = a[j] - b[j];
        const float sign = float(difference > 0) - float(difference < 0);
        out[j] = weights[0] * sign - share * weights[1] * (by_x[j] + 2 * a[j] * by_xx[j] + b[j] * by_xy[j]);
        by_x[j] = std::fabs(difference);
      }
      apart[r] = sum(by_x, row);
    }
  });
  sums[0] = sums[1] = 0;
  for (float each : apart) sums[0] += each;
  for (float each : unlike) sums[1] += share * each;
}
