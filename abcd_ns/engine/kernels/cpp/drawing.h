// The compositing of lists, forward and backward, and what else is asked of them.
#pragma once
#include "lists.h"

namespace drawing {
constexpr int CHANNELS = 3, RESIDUAL = 4;
constexpr int GROWTH = 10, ABSOLUTE = 2;  // sums of w f, w r, w r x, w r y; of |dL/dx|, |dL/dy|

struct Image {
  float *color, *transmittance, *depth;  // [h, w, 3], [h, w], [h, w]; null for none
  const float* residual;                 // [h, w, 3]
};

// One tile of a band: its pixels, and its Gaussians within a window.
struct Tile {
  float left, top;  // of the image
  I inside[VECTORS];
  bool whole;  // all of its pixels are the picture's
  int first, last;
  int64_t number;  // within the picture

  Tile(const Lists& lists, const Band& band, int tile, const Picture& picture) {
    const Place& place = lists.places[band.picture];
    const int col = place.first_col + tile % place.cols, row = place.first_row + band.first_row + tile / place.cols;
    left = float(col * SIDE), top = float(row * SIDE);
    number = int64_t(band.first_row) * place.cols + tile;
    const int end_x = picture.x + picture.width, end_y = picture.y + picture.height;
    whole = left >= picture.x && left + SIDE <= end_x && top >= picture.y && top + SIDE <= end_y;
    for (int v = 0; v < VECTORS; v++) inside[v] = I{} - 1;
    for (int p = 0; !whole && p < PIXELS; p++) {
      const int px = col * SIDE + p % SIDE, py = row * SIDE + p / SIDE;
      const bool in = px >= picture.x && px < end_x && py >= picture.y && py < end_y;
      inside[p / LANES][p % LANES] = in ? -1 : 0;
    }
    first = band.start[tile], last = band.start[tile + 1];
    if (picture.near) {  // entries are sorted by depth
      const auto begin = band.id.begin();
      const auto before = [&](int32_t id, float z) { return band.depth[id] < z; };
      const auto a = std::lower_bound(begin + first, begin + last, picture.near[number], before) - begin;
      const auto b = std::lower_bound(begin + first, begin + last, picture.far[number], before) - begin;
      first = int(a), last = int(std::max(a, b));
    }
  }

  // Calls f(vector, lane, index of the pixel in the picture) for its pixels.
  template <class F>
  void pixels(const Picture& picture, const F& f) const {
    const int px = int(left) - picture.x, py = int(top) - picture.y;
    for (int p = 0; p < PIXELS; p++)
      if (whole || inside[p / LANES][p % LANES])
        f(p / LANES, p % LANES, int64_t(py + p / SIDE) * picture.width + px + p % SIDE);
  }
};

struct Centers {  // of a tile's pixels, from its corner
  V x[VECTORS], y[VECTORS];
  Centers() {
    for (int p = 0; p < PIXELS; p++)
      x[p / LANES][p % LANES] = p % SIDE + 0.5f, y[p / LANES][p % LANES] = p / SIDE + 0.5f;
  }
};

// The light that is left in a tile's pixels; compositing stops for good at the fragment that would bring it to
// MIN_TRANSMITTANCE.
struct Light {
  V left[VECTORS];
  I live[VECTORS];

  explicit Light(const Tile& tile) {
    for (int v = 0; v < VECTORS; v++) left[v] = splat(1), live[v] = tile.inside[v];
  }
  V pass(int v, V alpha) {  // its weight
    const V takes = alpha * left[v], after = left[v] - takes;
    live[v] &= after > splat(MIN_TRANSMITTANCE);
    left[v] = live[v] ? after : left[v];
    return only(live[v], takes);
  }
  bool ends() const {
    I some = live[0];
    for (int v = 1; v < VECTORS; v++) some |= live[v];
    return !any(some);
  }
};

template <class Shape>
static inline V alpha_at(const float* r, const Tile& tile, const Centers& centers, int v) {
  return Shape::alpha(r, (r[0] - tile.left) - centers.x[v], (r[1] - tile.top) - centers.y[v]);
}

// For each tile of each band, by one thread a band.
template <class F>
static void each_tile(Lists& lists, const Picture* pictures, const F& f) {
  parallel(int64_t(lists.bands.size()), [&](int64_t b) {
    Band& band = lists.bands[b];
    const Picture& picture = pictures[band.picture];
    for (int t = 0; t + 1 < int(band.start.size()); t++) f(band, t, picture, Tile(lists, band, t, picture));
  });
}

// Draws what lies in `windows`; `keep` remembers how far each tile was drawn, for the way back.
template <class Shape>
static void draw(Lists& lists, const Picture* windows, const Image* images, bool keep) {
  each_tile(lists, windows, [&](Band& band, int t, const Picture& picture, const Tile& tile) {
    const Centers centers;
    Light light(tile);
    V sums[4][VECTORS] = {};
    int k = tile.first;
    for (; k < tile.last && !light.ends(); k++) {
      if (k + AHEAD < tile.last) __builtin_prefetch(lists.record(band, band.id[k + AHEAD]));
      const float* r = lists.record(band, band.id[k]);
      for (int v = 0; v < VECTORS; v++) {
        const V weight = light.pass(v, alpha_at<Shape>(r, tile, centers, v));
        for (int c = 0; c < CHANNELS; c++) sums[c][v] += weight * r[Shape::ALPHA + 1 + c];
        sums[3][v] += weight * r[2];
      }
    }
    if (keep) band.walked[t] = k;
    const Image& image = images[band.picture];
    tile.pixels(picture, [&](int v, int l, int64_t p) {
      for (int c = 0; c < CHANNELS; c++) image.color[3 * p + c] = sums[c][v][l];
      image.transmittance[p] = light.left[v][l];
      if (image.depth) image.depth[p] = sums[3][v][l];
    });
  });
}

// A few Gaussians of a tile that wait to be added up: their weights and dL/dsigma by pixel.
template <class Shape, int EXTRA>
struct Batch {
  static constexpr int SUMS = Shape::SUMS + EXTRA, PADDED = (SUMS + LANES - 1) / LANES * LANES;
  V weight[LANES][VECTORS], grad[LANES][VECTORS];
  int32_t id[LANES];
  int n = 0;

  void add_up(const Band& band, const Tile& tile, const float (*up)[PIXELS], const float (*residual)[PIXELS],
              float* sums) {
    for (int k = n; k < LANES; k++) {
      id[k] = id[0];
      for (int v = 0; v < VECTORS; v++) weight[k][v] = grad[k][v] = splat(0);
    }
    constexpr int TAKEN = (Shape::PARAMETERS + LANES - 1) / LANES * LANES;
    V r[TAKEN], found[PADDED] = {};
    for (int k = 0; k < TAKEN; k += LANES) {
      for (int l = 0; l < LANES; l++) r[k + l] = load(&band.record[size_t(id[l]) * RECORD + k]);
      transpose(r + k);
    }
    V dx[SIDE], dy[SIDE];
    for (int k = 0; k < SIDE; k++) dx[k] = r[0] - (tile.left + k + 0.5f), dy[k] = r[1] - (tile.top + k + 0.5f);
    for (int v = 0; v < VECTORS; v++) {
      V w[LANES], s[LANES];  // by pixel
#pragma GCC unroll 16
      for (int k = 0; k < LANES; k++) w[k] = weight[k][v], s[k] = grad[k][v];
      transpose(w), transpose(s);
#pragma GCC unroll 16
      for (int l = 0; l < LANES; l++) {
        const int p = v * LANES + l, px = p % SIDE, py = p / SIDE;
        Shape::add(r, dx[px], dy[py], s[l], found);
        for (int c = 0; c < 4; c++) found[Shape::COLORS + c] += w[l] * up[c][p];
        V* more = found + Shape::SUMS;
        if constexpr (EXTRA == ABSOLUTE) Shape::add_absolute(r, dx[px], dy[py], s[l], more);
        if constexpr (EXTRA == GROWTH) {
          more[0] += w[l] * residual[CHANNELS][p];
          for (int c = 0; c < CHANNELS; c++) {
            const V asks = w[l] * residual[c][p];
            more[1 + c] += asks, more[4 + c] -= asks * dx[px], more[7 + c] -= asks * dy[py];  // pixel - mean
          }
        }
      }
    }
    for (int k = 0; k < PADDED; k += LANES) {
      transpose(found + k);
      for (int l = 0; l < n; l++) {
        float* to = sums + size_t(id[l]) * PADDED + k;
        store(to, load(to) + found[k + l]);
      }
    }
    n = 0;
  }
};

// From the gradients of what was drawn, and the drawing, those of the first `own` columns.
//
// With e_k = dL/dC . (c_k, z_k), w_k = alpha_k T_k and total = sum of all w_k e_k + T dL/dT at the end:
//     dL/dalpha_k = T_k e_k - (total - sum of w_j e_j for j <= k) / (1 - alpha_k)
// so that front to back serves as well as back to front.
template <class Shape, int EXTRA>
static void draw_back(Lists& lists, int64_t own, const Image* grads, const Image* drawn, float* rows,
                      float* weights, float* extra) {
  using Few = Batch<Shape, EXTRA>;
  std::vector<std::vector<float>> sums(lists.bands.size());
  parallel(int64_t(lists.bands.size()), [&](int64_t b) {
    Band& band = lists.bands[b];
    Picture picture = lists.pictures[band.picture];
    picture.near = nullptr;  // the lists are within the window already
    const Image &grad = grads[band.picture], &picture_drawn = drawn[band.picture];
    sums[b].assign(band.reach.size() * Few::PADDED, 0.0f);
    std::vector<char> counts(band.reach.size());
    for (size_t j = 0; j < counts.size(); j++) counts[j] = lists.reaches[band.reach[j]].column < own;
    const Centers centers;
    Few few;
    for (int t = 0; t + 1 < int(band.start.size()); t++) {
      if (band.start[t] == band.walked[t]) continue;
      const Tile tile(lists, band, t, picture);
      float up[4][PIXELS] = {}, total[PIXELS] = {}, residual[RESIDUAL][PIXELS] = {};
      tile.pixels(picture, [&](int v, int l, int64_t p) {
        const int k = v * LANES + l;
        if (grad.color)
          for (int c = 0; c < CHANNELS; c++)
            up[c][k] = grad.color[3 * p + c], total[k] += up[c][k] * picture_drawn.color[3 * p + c];
        if (grad.depth) up[3][k] = grad.depth[p], total[k] += up[3][k] * picture_drawn.depth[p];
        if (grad.transmittance) total[k] += grad.transmittance[p] * picture_drawn.transmittance[p];
        if (EXTRA == GROWTH)
          for (int c = 0; c < RESIDUAL; c++) residual[c][k] = grad.residual[RESIDUAL * p + c];
      });
      V e[4][VECTORS], rest[VECTORS];
      for (int v = 0; v < VECTORS; v++) {
        rest[v] = load(total + v * LANES);
        for (int c = 0; c < 4; c++) e[c][v] = load(up[c] + v * LANES);
      }
      Light light(tile);
      for (int k = band.start[t]; k < band.walked[t]; k++) {
        if (k + AHEAD < band.walked[t]) __builtin_prefetch(lists.record(band, band.id[k + AHEAD]));
        const int32_t id = band.id[k];
        const float* r = lists.record(band, id);
        I some = I{};
        for (int v = 0; v < VECTORS; v++) {
          const V alpha = alpha_at<Shape>(r, tile, centers, v), before = light.left[v];
          V value = e[3][v] * r[2];
          for (int c = 0; c < CHANNELS; c++) value += e[c][v] * r[Shape::ALPHA + 1 + c];
          const V weight = light.pass(v, alpha);
          rest[v] -= weight * value;
          const V by_alpha = before * value - rest[v] / (1 - alpha);
          few.weight[few.n][v] = weight;
          // No gradient through the clamp, as in gsplat.
          few.grad[few.n][v] = only(light.live[v] & (alpha < splat(MAX_ALPHA)), -alpha * by_alpha);
          some |= weight > splat(0);
        }
        if (!counts[id] || !any(some)) continue;
        few.id[few.n++] = id;
        if (few.n == LANES) few.add_up(band, tile, up, residual, sums[b].data());
      }
      if (few.n) few.add_up(band, tile, up, residual, sums[b].data());
    }
  });
  // Bands one after the other; pictures beside each other, as their columns differ.
  parallel(int64_t(lists.pictures.size()), [&](int64_t k) {
    for (size_t b = 0; b < lists.bands.size(); b++) {
      const Band& band = lists.bands[b];
      if (band.picture != k) continue;
      for (size_t j = 0; j < band.reach.size(); j++) {
        const Reach& reach = lists.reaches[band.reach[j]];
        const int64_t column = reach.column, within = column - lists.first_column[reach.part];
        const Part& part = lists.parts[reach.part];
        if (column >= own) continue;
        const float* s = &sums[b][j * Few::PADDED];
        float g[Shape::GRADED];
        Shape::to_rows(lists.record(band, int(j)), part.planes + within, part.row, s, g);
        if (weights) weights[column] += g[2], g[2] = 0;
        float* to = rows + (column - within) * Shape::ROWS + within;
        for (int c = 0; c < Shape::GRADED; c++) to[c * part.count] += g[c];
        for (int c = 0; c < EXTRA; c++) extra[EXTRA * column + c] += s[Shape::SUMS + c];
      }
    }
  });
}

// Where a set of Gaussians shows, in each tile: see render/z_window.showing. `held` and `mass` are the sums of
// their weights, and of weight times z, in shares of the tile's pixels.
template <class Shape>
static void windows(Lists& lists, float visible, float* near, float* far, double* held, double* mass) {
  each_tile(lists, lists.pictures.data(), [&](Band& band, int, const Picture&, const Tile& tile) {
    const Centers centers;
    Light light(tile);
    int pixels = 0;
    for (int p = 0; p < PIXELS; p++) pixels += tile.inside[p / LANES][p % LANES] != 0;
    const int n = tile.last - tile.first;
    std::vector<double> share(n, 0.0);
    const int64_t out = lists.places[band.picture].first_tile + tile.number;
    double all = 0, of_z = 0;
    for (int k = 0; k < n && !light.ends(); k++) {
      const int32_t id = band.id[tile.first + k];
      const float* r = lists.record(band, id);
      V weight = splat(0);
      for (int v = 0; v < VECTORS; v++) weight += light.pass(v, alpha_at<Shape>(r, tile, centers, v));
      share[k] = double(sum(weight)) / std::max(pixels, 1);
      all += share[k], of_z += share[k] * band.depth[id];
    }
    double head = 0, tail = 0;
    float first = INFINITY, last = -INFINITY;
    for (int k = 0; k < n && first == INFINITY; k++)
      if ((head += share[k]) >= visible || visible <= 0) first = band.depth[band.id[tile.first + k]];
    for (int k = n - 1; k >= 0 && last == -INFINITY; k--)
      if ((tail += share[k]) >= visible || visible <= 0) last = band.depth[band.id[tile.first + k]];
    near[out] = first, far[out] = last, held[out] = all, mass[out] = of_z;
  });
}

// Marks the columns that have a fragment in the windows.
template <class Shape>
static void members(Lists& lists, const Picture* windows, uint8_t* found) {
  std::vector<std::vector<char>> of_band(lists.bands.size());
  parallel(int64_t(lists.bands.size()), [&](int64_t b) {
    const Band& band = lists.bands[b];
    of_band[b].assign(band.reach.size(), 0);
    for (int t = 0; t + 1 < int(band.start.size()); t++) {
      const Tile tile(lists, band, t, windows[band.picture]);
      for (int k = tile.first; k < tile.last; k++) of_band[b][band.id[k]] = 1;
    }
  });
  for (size_t b = 0; b < of_band.size(); b++)
    for (size_t j = 0; j < of_band[b].size(); j++) found[lists.reaches[lists.bands[b].reach[j]].column] |= of_band[b][j];
}

// The depth of the last fragment that is drawn while more than half of the light passes, behind what is given:
// `transmittance` (negative where it is a half or less) and `depth` of each picture, in place.
template <class Shape>
static void deepen(Lists& lists, const Picture* windows, const Image* images) {
  each_tile(lists, windows, [&](Band& band, int, const Picture& picture, const Tile& tile) {
    const Centers centers;
    V left[VECTORS] = {}, depth[VECTORS] = {};
    const Image& image = images[band.picture];
    tile.pixels(picture, [&](int v, int l, int64_t p) { left[v][l] = image.transmittance[p], depth[v][l] = image.depth[p]; });
    for (int k = tile.first; k < tile.last; k++) {
      const int32_t id = band.id[k];
      for (int v = 0; v < VECTORS; v++) {
        const V alpha = alpha_at<Shape>(lists.record(band, id), tile, centers, v);
        const I passes = left[v] > splat(0.5f);
        depth[v] = (passes & (alpha > splat(0))) ? splat(band.depth[id]) : depth[v];
        left[v] = passes ? left[v] * (1 - alpha) : left[v];
      }
    }
    tile.pixels(picture, [&](int v, int l, int64_t p) {
      image.transmittance[p] = left[v][l] > 0.5f ? left[v][l] : -std::fabs(left[v][l]), image.depth[p] = depth[v][l];
    });
  });
}
}  // namespace drawing

using drawing::Image, drawing::Lists, drawing::Part, drawing::Picture;
#define OF_SHAPE(lists, call) ((lists)->is_surfel ? drawing::call<drawing::Surfel> : drawing::call<drawing::Splat>)

extern "C" Lists* abcd_lists(int is_surfel, const Part* parts, int64_t n_parts, const Picture* pictures,
                             int64_t n_pictures, int weighs) {
  return (is_surfel ? drawing::build<drawing::Surfel> : drawing::build<drawing::Splat>)(parts, n_parts, pictures, n_pictures, weighs);
}
extern "C" void abcd_free(Lists* lists) { delete lists; }
extern "C" void abcd_draw(Lists* lists, const Picture* windows, const Image* images, int keep) {
  OF_SHAPE(lists, draw)(*lists, windows, images, keep);
}
// `rows` [views, rows, n], `weights` [views, n] (or null) and `extra` [views, n, sums] are zero before; `sums` is
// GROWTH, or ABSOLUTE (of splats), or 0.
extern "C" void abcd_draw_back(Lists* lists, int64_t own, const Image* grads, const Image* drawn, float* rows,
                               float* weights, float* extra, int64_t sums) {
  using namespace drawing;
  auto back = lists->is_surfel     ? (sums ? draw_back<Surfel, GROWTH> : draw_back<Surfel, 0>)
              : sums == ABSOLUTE ? draw_back<Splat, ABSOLUTE>
                                 : (sums ? draw_back<Splat, GROWTH> : draw_back<Splat, 0>);
  back(*lists, own, grads, drawn, rows, weights, extra);
}
extern "C" void abcd_windows(Lists* lists, float visible, float* near, float* far, double* held, double* mass) {
  OF_SHAPE(lists, windows)(*lists, visible, near, far, held, mass);
}
extern "C" void abcd_members(Lists* lists, const Picture* windows, uint8_t* found) {
  OF_SHAPE(lists, members)(*lists, windows, found);
}
extern "C" void abcd_deepen(Lists* lists, const Picture* windows, const Image* images) {
  OF_SHAPE(lists, deepen)(*lists, windows, images);
}
