// Gathers at the points of one block: the arithmetic of `gather_sums.py`.
//
// Weights are computed for many points at once. Values are read for one point after another, its
// channels at once: they lie side by side, so vectors of points would have to pick them singly.
//
// Compiled once for each instruction set; ISA names the result. Nothing of the standard library
// may be instantiated here: the linker would keep one copy for all processors.
#include "gather.h"
#include "vectors.h"

#ifndef ISA
#define ISA baseline
#endif
#define NAMED(prefix, isa) prefix##isa
#define OF_ISA(prefix, isa) NAMED(prefix, isa)
#define STRING(name) #name
#define NAME(name) STRING(name)

namespace jaxcloseup {
namespace {

typedef float Four __attribute__((vector_size(16)));
typedef int32_t Places __attribute__((vector_size(16)));
typedef float Channels __attribute__((vector_size(4 * LANES)));

inline V root(V x) {
#if defined(__AVX512F__)
  return (V)_mm512_maskz_sqrt_ps(-1, (__m512)x);
#elif defined(__AVX__)
  return (V)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE__)
  return (V)_mm_sqrt_ps((__m128)x);
#else
  for (int i = 0; i < WIDTH; i++) x[i] = __builtin_sqrtf(x[i]);
  return x;
#endif
}

// log2 of x > 0, to 1e-7; the coefficients are those of Cephes' logf.
inline V log2_of(V x) {
  // The mantissa is brought to [1 / sqrt(2), sqrt(2)).
  const I bits = (I)x - 0x3f3504f3, whole = bits >> 23;
  const V f = (V)((bits & 0x7fffff) + 0x3f3504f3) - 1.f, squared = f * f;
  V y = broadcast(7.0376836292e-2f);
  y = mad(y, f, broadcast(-1.1514610310e-1f));
  y = mad(y, f, broadcast(1.1676998740e-1f));
  y = mad(y, f, broadcast(-1.2420140846e-1f));
  y = mad(y, f, broadcast(1.4249322787e-1f));
  y = mad(y, f, broadcast(-1.6668057665e-1f));
  y = mad(y, f, broadcast(2.0000714765e-1f));
  y = mad(y, f, broadcast(-2.4999993993e-1f));
  y = mad(y, f, broadcast(3.3333331174e-1f));
  y = mad(y * f, squared, f - .5f * squared);
  return mad(y, broadcast(1.44269504f), __builtin_convertvector(whole, V));
}

// Arcsine of x in [0, 1], to 3e-7; the coefficients are those of Cephes' asinf.
inline V arcsine(V x) {
  const M large = less(broadcast(.5f), x);
  const V z = select(large, .5f * (1.f - x), x * x), r = select(large, root(z), x);
  V y = broadcast(4.2163199048e-2f);
  y = mad(y, z, broadcast(2.4181311049e-2f));
  y = mad(y, z, broadcast(4.5470025998e-2f));
  y = mad(y, z, broadcast(7.4953002686e-2f));
  y = mad(y, z, broadcast(1.6666752422e-1f));
  y = mad(y * z, r, r);
  return select(large, 1.57079633f - 2.f * y, y);
}

// The largest whole number that is not above x, which must fit.
inline I floor_of(V x) {
  const I whole = __builtin_convertvector(x, I);
  return whole + (I)(__builtin_convertvector(whole, V) > x);
}

// Whether the sphere around a block meets a photograph; never wrongly false, see `sphere_in_view`.
bool may_see(const Job& job, const Photograph& of, const Points& points) {
  float in_camera[3] = {};
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) in_camera[k] += (points.center[i] - of.position[i]) * of.rotation[3 * i + k];
  const float z = in_camera[2], radius = points.radius;
  if (z <= -radius) return false;
  const int sizes[2] = {job.width, job.height};
  for (int axis = 0; axis < 2; axis++) {
    const float across = of.focal[axis] * in_camera[axis], first = of.center[axis], last = sizes[axis] - first;
    if (across + first * z < -radius * of.lengths[2 * axis]) return false;
    if (-across + last * z < -radius * of.lengths[2 * axis + 1]) return false;
  }
  return true;
}

// Reads a photograph's interleaved maps, linearly between pixels.
inline void read_maps(const Job& job, const float* maps, I place, V wx, V wy, V& inverse, V& trust) {
  int32_t places[WIDTH];
  float x[WIDTH], y[WIDTH], inverses[WIDTH], trusts[WIDTH];
  std::memcpy(places, &place, sizeof place);
  store(x, wx);
  store(y, wy);
  const int row = 2 * (job.width + 2);
  for (int i = 0; i < WIDTH; i++) {
    Four top, bottom;
    std::memcpy(&top, maps + places[i], sizeof top);
    std::memcpy(&bottom, maps + places[i] + row, sizeof bottom);
    const Four both = (1 - y[i]) * top + y[i] * bottom;
    inverses[i] = (1 - x[i]) * both[0] + x[i] * both[2];
    trusts[i] = (1 - x[i]) * both[1] + x[i] * both[3];
  }
  inverse = load(inverses);
  trust = load(trusts);
}

// Adds a photograph's weights to the sums of a block; returns whether it sees any point.
bool weigh(const Job& job, int index, const Points& points, Workspace& work, Record& record) {
  const Photograph& of = job.photograph[index];
  const float* maps = job.maps + index * job.map_size();
  const float* r = of.rotation;
  bool sees = false;
  record.photograph = index;
  for (int j = 0; j < points.count; j += WIDTH) {
    const V side = load(points.side + j);
    V from[3];  // the photograph
    for (int i = 0; i < 3; i++) from[i] = load(points.at[i] + j) - of.position[i];
    V in_camera[3];
    for (int k = 0; k < 3; k++)
      in_camera[k] = mad(from[2], broadcast(r[6 + k]), mad(from[1], broadcast(r[3 + k]), from[0] * r[k]));
    const V z = in_camera[2];
    const V inverse_z = 1.f / select(less(broadcast(1.1920929e-7f), z), z, broadcast(1));
    const V x = in_camera[0] * inverse_z, y = in_camera[1] * inverse_z;
    const V u = mad(x, broadcast(of.focal[0]), broadcast(of.center[0]));
    const V v = mad(y, broadcast(of.focal[1]), broadcast(of.center[1]));
    const M known = less(V{}, side) & less(V{}, z);
    const M inside = known & at_most(V{}, u) & less(u, broadcast(job.width)) & at_most(V{}, v) &
                     less(v, broadcast(job.height));
    for (int k = 0; k < job.parts; k++) store(record.weight[k] + j, V{});
    if (!any(inside)) continue;
    const V px = select(inside, u, broadcast(.5f)) - .5f, py = select(inside, v, broadcast(.5f)) - .5f;
    const I column = floor_of(px), row = floor_of(py);
    V inverse, trust;
    read_maps(job, maps, 2 * ((row + 1) * (job.width + 2) + column + 1), px - __builtin_convertvector(column, V),
              py - __builtin_convertvector(row, V), inverse, trust);
    V seen[MOST_PARTS];
    M any_seen = less(broadcast(1), V{});
    const V difference = z * inverse - 1.f;
    for (int k = 0; k < job.parts; k++) {
      const V relative = difference / job.settings[k].tolerance;
      const V near = greater(1.f - relative * relative, V{});
      seen[k] = select(inside, trust * (near * near));
      any_seen = any_seen | less(V{}, seen[k]);
    }
    if (!any(any_seen)) continue;
    sees = true;
    // How far the photograph's ray turns from the view's.
    const V length = root(mad(from[2], from[2], mad(from[1], from[1], from[0] * from[0])));
    const V unit = select(less(V{}, length), 1.f / length);
    V apart = V{};
    for (int i = 0; i < 3; i++) {
      const V turn = load(points.ray[i] + j) - from[i] * unit;
      apart = mad(turn, turn, apart);
    }
    const V angle = 2.f * arcsine(lesser(.5f * root(apart), broadcast(.999f)));
    const V ratio = select(known, z / select(known, side, broadcast(1)), broadcast(1));
    const V size = log2_of(ratio) - of.log_focal, sharpest = size + of.coarseness[job.finest];
    const V footprint = ratio * of.footprint;
    const V clipped = lesser(greater(footprint, broadcast(1)), broadcast(COARSEST));
    const V sharpness = 1.f / (clipped * clipped);
    store(record.ray[0] + j, x);
    store(record.ray[1] + j, y);
    store(record.size + j, size);
    V straight = V{};
    for (int k = 0; k < job.parts; k++) {
      const Settings& settings = job.settings[k];
      if (k == 0 || settings.angle_scale != job.settings[k - 1].angle_scale)
        straight = sharpness * exponential(-lesser(angle / settings.angle_scale, broadcast(WIDEST)));
      const M sees_some = less(V{}, seen[k]);
      const V weight = select(sees_some, seen[k] * straight);
      store(record.weight[k] + j, weight);
      PartSums& sums = work.parts[k];
      store(sums.weight + j, load(sums.weight + j) + weight);
      store(sums.count + j, load(sums.count + j) + select(sees_some, seen[k]));
      const V finest = load(sums.footprint + j);
      store(sums.footprint + j, select(sees_some & less(footprint, finest), footprint, finest));
      store(sums.detail + j, load(sums.detail + j) - weight * sharpest);
      store(sums.angle + j, load(sums.angle + j) + weight * angle);
    }
  }
  return sees;
}

template <typename T>
inline Channels load_channels(const T* from) {
  T read[LANES];
  std::memcpy(read, from, sizeof read);
  Channels to;
  for (int i = 0; i < LANES; i++) to[i] = read[i];
  return to;
}
#if defined(__AVX2__)
template <>
inline Channels load_channels(const int8_t* from) {
  return (Channels)_mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_loadl_epi64((const __m128i*)from)));
}
template <>
inline Channels load_channels(const uint8_t* from) {
  return (Channels)_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i*)from)));
}
#endif

// Adds a share of one pixel's channels to a value. Vectors may reach beyond a pixel, not the image.
template <typename T>
inline void add_pixel(const Job& job, const T* from, const T* end, int vectors, float share, Channels* value) {
  const int channels = job.channels;
  for (int v = 0; v < vectors; v++, from += LANES) {
    if (__builtin_expect(end - from >= LANES, 1)) {
      value[v] += share * load_channels(from);
    } else {
      T rest[LANES] = {};
      std::memcpy(rest, from, (channels - v * LANES < LANES ? channels - v * LANES : LANES) * sizeof(T));
      value[v] += share * load_channels(rest);
    }
  }
}

// Where a point falls on two neighboring levels, and how much of each of the four pixels around it
// counts there.
struct Taps {
  int32_t place[8];
  float share[8];
};

inline Taps find_taps(const LevelPair& pair, float x, float y, float coarser) {
  const Four at = {x, y, x, y};
  Four focal, center, most;
  std::memcpy(&focal, pair.focal, sizeof focal);
  std::memcpy(&center, pair.center, sizeof center);
  std::memcpy(&most, pair.most, sizeof most);
  Four pixel = at * focal + (center - .5f);
  pixel = pixel > -2.f ? pixel : Four{} - 2.f;  // also if not a number
  pixel = pixel < 0x1p20f ? pixel : Four{} + 0x1p20f;
  const Places whole = __builtin_convertvector(pixel, Places);
  const Four corner = __builtin_convertvector(whole + (Places)(__builtin_convertvector(whole, Four) > pixel), Four);
  const Four after = pixel - corner, before = 1.f - after, next = corner + 1.f;
  const auto clip = [&](Four to) {
    to = to > 0.f ? to : Four{};
    return __builtin_convertvector(to < most ? to : most, Places);
  };
  const Places first = clip(corner), last = clip(next);
  Taps taps;
  for (int level = 0; level < 2; level++) {
    const int i = 2 * level, k = 4 * level, width = pair.width[level], start = pair.start[level];
    const float part = level ? coarser : 1 - coarser;
    const int32_t top = start + first[i + 1] * width, bottom = start + last[i + 1] * width;
    taps.place[k] = top + first[i];
    taps.place[k + 1] = top + last[i];
    taps.place[k + 2] = bottom + first[i];
    taps.place[k + 3] = bottom + last[i];
    const float above = part * before[i + 1], below = part * after[i + 1];
    taps.share[k] = above * before[i];
    taps.share[k + 1] = above * after[i];
    taps.share[k + 2] = below * before[i];
    taps.share[k + 3] = below * after[i];
  }
  return taps;
}

template <typename T>
inline float unit_of() {
  return sizeof(T) > 1 ? 1.f : T(-1) < T(0) ? 1 / 127.f : 1 / 255.f;
}

// Reads what the recorded photographs show and adds it, by their weights; once more for robust
// parts, which compare it with the mean. VECTORS is the number of vectors of channels, or 0 for any.
template <typename T, int VECTORS>
void add_values(const Job& job, const Points& points, Workspace& work, int records, bool again) {
  constexpr int MOST = VECTORS ? VECTORS : MOST_CHANNELS / LANES;
  const int vectors = VECTORS ? VECTORS : job.vectors(), each = job.part_channels();
  float* sums = again ? work.robust : work.values;
  for (int group = 0; group < job.parts; group++) {
    // Parts that are read alike are read together, with the first of them.
    const float finer = job.settings[group].finer;
    bool own[MOST_PARTS], first = true, wanted = false;
    for (int k = 0; k < job.parts; k++) {
      own[k] = job.settings[k].finer == finer && (!again || job.settings[k].robust != 0);
      first = first && !(k < group && job.settings[k].finer == finer);
      wanted = wanted || own[k];
    }
    if (!first || !wanted) continue;
    Channels lanes[MOST_PARTS][MOST];  // 1 in the channels of a part
    for (int k = 0; k < job.parts; k++)
      for (int c = 0; c < vectors * LANES; c++) lanes[k][c / LANES][c % LANES] = own[k] && c / each == k;
    for (int i = 0; i < records; i++) {
      const Record& record = work.records[i];
      const Photograph& of = job.photograph[record.photograph];
      const LevelPair* pairs = job.pairs + record.photograph * job.levels;
      const T* values = static_cast<const T*>(job.values) + record.photograph * job.pixels * job.channels;
      const T* end = static_cast<const T*>(job.values) + job.photographs * job.pixels * job.channels;
      int32_t levels[BLOCK];
      float shares[BLOCK];
      for (int j = 0; j < points.count; j += WIDTH) {
        const V coarser = -load(record.size + j) - finer;
        V level = V{};
        for (int l = 0; l + 1 < job.levels; l++) {
          const float step = of.coarseness[l + 1] - of.coarseness[l];
          level += lesser(greater((coarser - of.coarseness[l]) / step, V{}), broadcast(1));
        }
        level = greater(level, broadcast(job.finest));
        const V whole = __builtin_convertvector(__builtin_convertvector(level, I), V);
        store(shares + j, level - whole);
        const I index = __builtin_convertvector(whole, I);
        std::memcpy(levels + j, &index, sizeof index);
      }
      for (int p = 0; p < points.count; p++) {
        float weight[MOST_PARTS];
        bool matters = false;
        for (int k = 0; k < job.parts; k++) {
          weight[k] = record.weight[k][p];
          matters = matters || (own[k] && weight[k] > NEGLIGIBLE * work.parts[k].weight[p]);
        }
        if (!matters) continue;
        const Taps taps = find_taps(pairs[levels[p]], record.ray[0][p], record.ray[1][p], shares[p]);
        Channels value[MOST];
        for (int v = 0; v < vectors; v++) value[v] = Channels{};
        const int count = shares[p] > 0 ? 8 : 4;
        for (int t = 0; t < count; t++)
          add_pixel(job, values + int64_t(taps.place[t]) * job.channels, end, vectors, taps.share[t], value);
        if (again) {
          const float* mean = work.values + p * vectors * LANES;
          for (int k = 0; k < job.parts; k++) {
            if (!own[k]) continue;
            float apart = 0;
            for (int c = k * each; c < (k + 1) * each; c++) {
              const float off = unit_of<T>() * value[c / LANES][c % LANES] - mean[c];
              apart += off * off;
            }
            const float variance = work.parts[k].variance[p];
            const float odd = variance == 0 ? 1 : 1 + job.settings[k].robust * (apart / each) / variance;
            weight[k] /= odd * odd;
            work.robust_weight[k][p] += weight[k];
          }
        }
        for (int v = 0; v < vectors; v++) {
          Channels share = weight[0] * lanes[0][v];
          for (int k = 1; k < job.parts; k++) share += weight[k] * lanes[k][v];
          Channels sum;
          const int place = (p * vectors + v) * LANES;
          std::memcpy(&sum, sums + place, sizeof sum);
          const Channels weighted = share * value[v];
          sum += weighted;
          std::memcpy(sums + place, &sum, sizeof sum);
          if (again) continue;
          std::memcpy(&sum, work.squares + place, sizeof sum);
          sum += weighted * value[v];
          std::memcpy(work.squares + place, &sum, sizeof sum);
        }
      }
    }
  }
}

inline float divide(float a, float b) { return b == 0 ? 0 : a / b; }

// Divides sums by weights.
void finish(const Job& job, const Points& points, Workspace& work, float unit) {
  const int each = job.part_channels(), stride = job.vectors() * LANES;
  for (int k = 0; k < job.parts; k++) {
    PartSums& part = work.parts[k];
    for (int p = 0; p < points.count; p++) {
      float *mean = work.values + p * stride + k * each, *squares = work.squares + p * stride + k * each;
      const float weight = part.weight[p];
      float square = 0, of_mean = 0;
      for (int c = 0; c < each; c++) {
        mean[c] = divide(mean[c] * unit, weight);
        square += divide(squares[c] * unit * unit, weight);
        of_mean += mean[c] * mean[c];
      }
      const float variance = (square - of_mean) / each;
      part.variance[p] = variance < 0 ? 0 : variance;
      part.detail[p] = divide(part.detail[p], weight);
      part.angle[p] = divide(part.angle[p], weight);
    }
  }
}

// Puts robust means and weights in place of the plain ones.
void finish_robust(const Job& job, const Points& points, Workspace& work, float unit) {
  const int each = job.part_channels(), stride = job.vectors() * LANES;
  for (int k = 0; k < job.parts; k++) {
    if (job.settings[k].robust == 0) continue;
    for (int p = 0; p < points.count; p++) {
      const float weight = work.robust_weight[k][p];
      work.parts[k].weight[p] = weight;
      for (int c = k * each; c < (k + 1) * each; c++)
        work.values[p * stride + c] = divide(work.robust[p * stride + c] * unit, weight);
    }
  }
}

template <typename T>
void read_values(const Job& job, const Points& points, Workspace& work, int records) {
  const auto add = job.vectors() == 1 ? add_values<T, 1> : add_values<T, 0>;
  const size_t size = size_t(BLOCK) * job.vectors() * LANES * sizeof(float);
  std::memset(work.values, 0, size);
  std::memset(work.squares, 0, size);
  add(job, points, work, records, false);
  finish(job, points, work, unit_of<T>());
  bool robust = false;
  for (int k = 0; k < job.parts; k++) robust = robust || job.settings[k].robust != 0;
  if (!robust) return;
  std::memset(work.robust, 0, size);
  std::memset(work.robust_weight, 0, sizeof work.robust_weight);
  add(job, points, work, records, true);
  finish_robust(job, points, work, unit_of<T>());
}

void gather(const Job& job, const Points& points, Workspace& work) {
  std::memset(work.parts, 0, sizeof work.parts);
  for (int k = 0; k < job.parts; k++)
    for (int p = 0; p < BLOCK; p++) work.parts[k].footprint[p] = __builtin_inff();
  int records = 0;
  for (int i = 0; i < job.photographs; i++)
    if (i != job.exclude && may_see(job, job.photograph[i], points))
      records += weigh(job, i, points, work, work.records[records]);
  if (job.kind == Kind::INT8) return read_values<int8_t>(job, points, work, records);
  if (job.kind == Kind::UINT8) return read_values<uint8_t>(job, points, work, records);
  read_values<float>(job, points, work, records);
}

}  // namespace

extern const Gatherer OF_ISA(gatherer_, ISA) = {NAME(ISA), gather};

}  // namespace jaxcloseup
