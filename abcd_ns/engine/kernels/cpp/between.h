// A drawing between two layers, on a background: layers/compositing.py has the algebra, and the same in torch.
#pragma once
#include "threads.h"

namespace between {
constexpr int64_t AT_ONCE = 1 << 13;

struct Layer {  // [n, 3] and [n], with so many floats from pixel to pixel; without colour, nothing
  const float *color, *transmittance;
  int64_t color_step, transmittance_step;
};

struct Shown {
  Layer front, drawn, back;
  const float* background;
};

struct Pixel {
  float behind[3], value[3], through = 1;

  template <bool LAYERS>
  static Pixel of(const Shown& s, int64_t k) {
    Pixel p;
    const float* own = s.drawn.color + k * s.drawn.color_step;
    const float left = s.drawn.transmittance[k * s.drawn.transmittance_step];
    const float *front = nullptr, *back = nullptr;
    float beyond = 0;
    if (LAYERS) {
      front = s.front.color + k * s.front.color_step, back = s.back.color + k * s.back.color_step;
      p.through = s.front.transmittance[k * s.front.transmittance_step];
      beyond = s.back.transmittance[k * s.back.transmittance_step];
    }
    for (int i = 0; i < 3; i++) {
      p.behind[i] = LAYERS ? back[i] + beyond * s.background[i] : s.background[i];
      const float seen = own[i] + left * p.behind[i];
      p.value[i] = LAYERS ? front[i] + p.through * seen : seen;
    }
    return p;
  }
};

template <class Job>
static inline void pixels(int64_t n, const Shown& shown, const Job& job) {
  const Shown s = shown;
  parallel_ranges(n, AT_ONCE, [&](int64_t begin, int64_t end) {
    if (s.front.color)
      for (int64_t k = begin; k < end; k++) job(k, Pixel::of<true>(s, k));
    else
      for (int64_t k = begin; k < end; k++) job(k, Pixel::of<false>(s, k));
  });
}
}  // namespace between

// picture: [n, 3], 0..1; what is no number stays so.
extern "C" void abcd_between(int64_t n, const between::Shown* shown, float* picture) {
  between::pixels(n, *shown, [=](int64_t k, const between::Pixel& p) {
    for (int i = 0; i < 3; i++) picture[3 * k + i] = p.value[i] < 0 ? 0 : p.value[i] > 1 ? 1 : p.value[i];
  });
}

// From the gradient by the picture those by what was drawn; by_depth is `counts` of what shows of a pixel.
extern "C" void abcd_between_back(int64_t n, const between::Shown* shown, const float* gradient, float counts,
                                  float* by_color, float* by_transmittance, float* by_depth) {
  between::pixels(n, *shown, [=](int64_t k, const between::Pixel& p) {
    float sum = 0;
    for (int i = 0; i < 3; i++) {
      const float within = float(p.value[i] >= 0) * float(p.value[i] <= 1);
      const float by = within * p.through * gradient[3 * k + i];
      by_color[3 * k + i] = by, sum += by * p.behind[i];
    }
    by_transmittance[k] = sum, by_depth[k] = counts * p.through;
  });
}

// What a picture lacks of its photo behind a layer, if any, and how much of that shows: [n, 4]. Gives the sum
// of squares of what it lacks.
extern "C" double abcd_residual(int64_t n, const float* picture, const float* photo, const float* in_front,
                                float* residual) {
  double sum = 0;
  for (int64_t k = 0; k < n; k++) {
    const float through = in_front ? in_front[k] : 1;
    float square = 0;
    for (int i = 0; i < 3; i++) {
      const float lacks = photo[3 * k + i] - picture[3 * k + i];
      square += lacks * lacks, residual[4 * k + i] = through * lacks;
    }
    residual[4 * k + 3] = through, sum += square;
  }
  return sum;
}
