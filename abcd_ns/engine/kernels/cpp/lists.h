// Which Gaussians each tile draws, and in what order.
//
// A tile of 4 x 4 pixels is 16 lanes. Rows of tiles make bands, which are worked on by one thread each: sums
// are added up within a band and then band by band, so that no result depends on the number of threads.
#pragma once
#include <algorithm>
#include <memory>
#include <vector>

#include "shapes.h"
#include "threads.h"

namespace drawing {
constexpr int SIDE = 4, PIXELS = SIDE * SIDE, VECTORS = PIXELS / LANES;
constexpr int64_t AT_ONCE = 4096;
constexpr int AHEAD = 10;  // records are fetched so many before they are needed

// Columns of planes that are drawn into one picture. As in Python, see cpu/native.py.
struct Part {
  const float* planes;
  int64_t row, count;  // floats from one row to the next; columns
  int32_t picture, masked;
};
struct Picture {
  int32_t x, y, width, height;
  const float *near, *far;  // a number for each tile; null for no window
};

struct Place {  // of a picture's tiles
  int first_col, first_row, cols, rows;
  int64_t first_tile;
};

struct alignas(64) Reach {  // a Gaussian that may be drawn, and the rows of tiles of its picture that it reaches
  float record[RECORD];
  Bound bound;
  int32_t column, part, first_row, rows;
};

struct Band {
  int picture, first_row, rows;  // rows of tiles, counted from the picture's first
  std::vector<int32_t> reach;    // by depth; then what is drawn of each
  std::vector<float> depth, record;
  std::vector<int32_t> start, id, walked;  // by tile; `id` counts within the band
};

struct Lists {
  bool is_surfel, weighs;
  std::vector<Part> parts;
  std::vector<int64_t> first_column;  // of the parts
  std::vector<Picture> pictures;
  std::vector<Place> places;
  std::vector<Reach> reaches;  // by column
  std::vector<Band> bands;

  const float* record(const Band& band, int id) const { return &band.record[size_t(id) * RECORD]; }
};

template <class Shape>
static bool reaches(const float* planes, int64_t row, const Picture& p, int first_row, Reach& found) {
  const float x = planes[0], y = planes[row], radius = planes[Shape::RADIUS * row];
  if (!(radius > 0) || !(planes[Shape::OPACITY * row] >= MIN_ALPHA)) return false;
  if (!(x + radius + GSPLAT_TILE > p.x) || !(x - radius - GSPLAT_TILE < p.x + p.width)) return false;
  if (!(y + radius + GSPLAT_TILE > p.y) || !(y - radius - GSPLAT_TILE < p.y + p.height)) return false;
  const Bound e = found.bound = Shape::bound(planes, row);
  // The rows of pixel centres within the ellipse, the crop and gsplat's rectangle.
  const float low = std::ceil(e.y - e.half_height - 0.5f), high = std::floor(e.y + e.half_height - 0.5f);
  const float a = std::max({low, gsplat_first(y, radius), float(p.y)});
  const float b = std::min({high, gsplat_last(y, radius), float(p.y + p.height - 1)});
  if (!(a <= b)) return false;
  found.first_row = int(a) / SIDE - first_row, found.rows = int(b) / SIDE - first_row + 1 - found.first_row;
  Shape::record(planes, row, found.record);
  return true;
}

// In each of some rows of tiles (LANES of them, from `row` of the image) the first tile that the ellipse
// reaches, and how many; 0 and less for none. At height v over the middle it spans v slope -+ a half width; its right
// end is furthest out at v = flank, its left end at v = -flank.
static inline void tiles_of_rows(const Bound& e, int row, const Picture& p, I& first, I& count) {
  static_assert(LANES >= 4, "a band has up to 4 rows");
  V step;
  for (int l = 0; l < LANES; l++) step[l] = float(l * SIDE);
  const V top = step + (row * SIDE + 0.5f - e.y), bottom = top + (SIDE - 1);
  const V right_v = vmin(vmax(splat(e.flank), top), bottom), left_v = vmin(vmax(splat(-e.flank), top), bottom);
  const V right = vsqrt(vmax(e.reach - right_v * right_v * e.per_variance, splat(0)) * e.per_precision);
  const V left = vsqrt(vmax(e.reach - left_v * left_v * e.per_variance, splat(0)) * e.per_precision);
  const V low = vceil(e.x + left_v * e.slope - left - 0.5f), high = vfloor(e.x + right_v * e.slope + right - 0.5f);
  const V a = vmax(low, splat(std::max(e.left, float(p.x))));
  const V b = vmin(high, splat(std::min(e.right, float(p.x + p.width - 1))));
  first = __builtin_convertvector(vmin(a, splat(p.x + p.width)), I) / SIDE;
  count = __builtin_convertvector(vmax(b, splat(p.x - SIDE)), I) / SIDE - first + 1;
  count = (a <= b) & count;
}

// By depth; what has the same keeps its order.
static void sort_by_depth(Band& band, std::vector<uint64_t>& keys) {
  const size_t n = keys.size();
  if (n < 256) {
    std::sort(keys.begin(), keys.end());  // indices ascend, so that ties keep their order
  } else {
    std::vector<uint64_t> other(n);
    for (int shift = 32; shift < 64; shift += 11) {
      uint32_t count[2049] = {};
      for (uint64_t key : keys) count[(key >> shift & 2047) + 1]++;
      for (int k = 0; k < 2048; k++) count[k + 1] += count[k];
      for (uint64_t key : keys) other[count[key >> shift & 2047]++] = key;
      keys.swap(other);
    }
  }
  band.reach.resize(n), band.depth.resize(n);
  for (size_t k = 0; k < n; k++) {
    const uint32_t bits = uint32_t(keys[k] >> 32);  // positive floats are in the order of their bits
    band.reach[k] = int32_t(uint32_t(keys[k]));
    std::memcpy(&band.depth[k], &bits, 4);
  }
}

template <class Shape>
static void fill(const Lists& lists, Band& band, std::vector<uint64_t>& keys) {
  struct Run {
    int32_t id, first, count;
  };
  sort_by_depth(band, keys);
  const Picture& picture = lists.pictures[band.picture];
  const Place& place = lists.places[band.picture];
  const int n = int(band.reach.size()), tiles = band.rows * place.cols;
  band.record.resize(size_t(n) * RECORD);
  band.start.assign(tiles + 1, 0), band.walked.assign(tiles, 0);
  std::vector<Run> runs;
  runs.reserve(size_t(n) * 2);
  const auto masks = [&](int id) { return picture.near && lists.parts[lists.reaches[band.reach[id]].part].masked; };
  const auto held = [&](int id, int tile) {
    const int64_t t = int64_t(band.first_row) * place.cols + tile;
    return band.depth[id] >= picture.near[t] && band.depth[id] < picture.far[t];
  };
  for (int id = 0; id < n; id++) {
    const Reach& reach = lists.reaches[band.reach[id]];
    if (id + AHEAD < n) {
      const Reach& next = lists.reaches[band.reach[id + AHEAD]];
      __builtin_prefetch(next.record), __builtin_prefetch(&next.bound);
    }
    float* r = &band.record[size_t(id) * RECORD];
    std::memcpy(r, reach.record, sizeof reach.record);
    if (lists.weighs) r[2] = 0;
    I first, count;
    tiles_of_rows(reach.bound, band.first_row + place.first_row, picture, first, count);
    const int begin = std::max(reach.first_row - band.first_row, 0);
    const int end = std::min(reach.first_row + reach.rows - band.first_row, band.rows);
    const bool masked = masks(id);
    for (int row = begin; row < end; row++) {
      if (count[row] <= 0) continue;
      const int tile = row * place.cols + first[row] - place.first_col;
      runs.push_back({id, tile, count[row]});
      for (int k = tile; k < tile + count[row]; k++) band.start[k + 1] += !masked || held(id, k);
    }
  }
  for (int t = 0; t < tiles; t++) band.start[t + 1] += band.start[t];
  band.id.resize(band.start[tiles]);
  std::vector<int32_t> next(band.start.begin(), band.start.end() - 1);
  for (const Run& run : runs) {
    const bool masked = masks(run.id);
    for (int k = run.first; k < run.first + run.count; k++)
      if (!masked || held(run.id, k)) band.id[next[k]++] = run.id;
  }
}

template <class Shape>
static Lists* build(const Part* parts, int64_t n_parts, const Picture* pictures, int64_t n_pictures, bool weighs) {
  auto lists = std::make_unique<Lists>();
  lists->is_surfel = Shape::IS_SURFEL, lists->weighs = weighs;
  lists->parts.assign(parts, parts + n_parts), lists->pictures.assign(pictures, pictures + n_pictures);
  std::vector<int> first_band, height;  // by picture; low pictures have more bands, for there are several threads
  int64_t tiles = 0;
  for (int k = 0; k < n_pictures; k++) {
    const Picture& p = pictures[k];
    const int col = p.x / SIDE, row = p.y / SIDE;
    const int cols = (p.x + p.width + SIDE - 1) / SIDE - col, rows = (p.y + p.height + SIDE - 1) / SIDE - row;
    lists->places.push_back({col, row, cols, rows, tiles});
    tiles += int64_t(cols) * rows;
    first_band.push_back(int(lists->bands.size())), height.push_back(rows < 40 ? 2 : 4);
    for (int r = 0; r < rows; r += height[k])
      lists->bands.push_back({k, r, std::min(height[k], rows - r), {}, {}, {}, {}, {}, {}});
  }
  struct Some {
    int32_t part;
    int64_t begin, end;
  };
  std::vector<Some> some;
  int64_t columns = 0;
  for (int k = 0; k < n_parts; k++) {
    lists->first_column.push_back(columns), columns += parts[k].count;
    for (int64_t b = 0; b < parts[k].count; b += AT_ONCE)
      some.push_back({k, b, std::min(b + AT_ONCE, parts[k].count)});
  }
  std::vector<std::vector<Reach>> found(some.size());
  parallel(int64_t(some.size()), [&](int64_t s) {
    const Part& part = lists->parts[some[s].part];
    const int first_row = lists->places[part.picture].first_row;
    Reach reach;
    found[s].reserve(AT_ONCE / 4);
    for (int64_t i = some[s].begin; i < some[s].end; i++)
      if (reaches<Shape>(part.planes + i, part.row, pictures[part.picture], first_row, reach)) {
        reach.column = int32_t(lists->first_column[some[s].part] + i), reach.part = some[s].part;
        found[s].push_back(reach);
      }
  });
  size_t total = 0;
  for (const auto& each : found) total += each.size();
  lists->reaches.reserve(total);
  for (const auto& each : found) lists->reaches.insert(lists->reaches.end(), each.begin(), each.end());
  std::vector<std::vector<uint64_t>> keys(lists->bands.size());
  for (size_t k = 0; k < total; k++) {
    const Reach& reach = lists->reaches[k];
    const Part& part = parts[reach.part];
    const int h = height[part.picture];
    uint32_t bits;
    std::memcpy(&bits, part.planes + 2 * part.row + reach.column - lists->first_column[reach.part], 4);
    for (int b = reach.first_row / h; b <= (reach.first_row + reach.rows - 1) / h; b++)
      keys[first_band[part.picture] + b].push_back(uint64_t(bits) << 32 | k);
  }
  parallel(int64_t(lists->bands.size()), [&](int64_t b) { fill<Shape>(*lists, lists->bands[b], keys[b]); });
  for (Picture& p : lists->pictures) p.near = p.far = nullptr;  // the caller keeps them for this call only
  return lists.release();
}
}  // namespace drawing
