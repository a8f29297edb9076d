// One step of Adam (Kingma and Ba 2015, algorithm 1), in one pass over memory.
#pragma once
#include "threads.h"

extern "C" void abcd_adam(int64_t n, float* values, const float* grads, float* first, float* second, float rate,
                          float beta1, float beta2, float root_correction2, float eps) {
  parallel_ranges(n, 1 << 15, [=](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; k++) {
      const float g = grads[k];
      const float m = first[k] + (1 - beta1) * (g - first[k]);
      const float v = beta2 * second[k] + (1 - beta2) * (g * g);
      first[k] = m, second[k] = v;
      values[k] -= rate * m / (std::sqrt(v) / root_correction2 + eps);
    }
  });
}
