// Gathers at the points of one block: the arithmetic of `gather_sums.py`.
//
// Weights are computed for many points at once. Values are read for one point after another, its
// channels at once: they lie side by side, so vectors of points would have to pick them singly.
//
// Compiled once for each instruction set; ISA names the result. Nothing of the standard library
// may be instantiated here: the linker would keep one copy for all processors.
#include "gather.h"
#include "isa.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

typedef float Four __attribute__((vector_size(16)));
typedef float Channels __attribute__((vector_size(4 * LANES)));

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
    const V size = 1.44269504f * logarithm(ratio) - of.log_focal, sharpest = size + of.coarseness[job.finest];
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

// a b + c
inline Channels add_product(Channels a, Channels b, Channels c) {
#if defined(__FMA__)
  return (Channels)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}

// Values, and where reading must end: vectors may reach beyond a pixel.
template <typename T>
struct Values {
  const T *first, *end;
  int channels;
};

// Adds shares of two pixels that lie side by side to a value; the second one may lie beyond a row,
// without a share.
template <typename T>
inline void add_pixels(const Values<T>& values, int32_t place, float left, float right, int vectors, Channels* value) {
  const T* from = values.first + int64_t(place) * values.channels;
  if (__builtin_expect(values.end - from >= values.channels + vectors * LANES, 1)) {
    const bool both = sizeof(T) == 1 || right != 0;  // floats may not be numbers
    for (int v = 0; v < vectors; v++) {
      value[v] = add_product(Channels{} + left, load_channels(from + v * LANES), value[v]);
      if (both) value[v] = add_product(Channels{} + right, load_channels(from + values.channels + v * LANES), value[v]);
    }
    return;
  }
  for (int c = 0; c < values.channels; c++) {
    float& sum = reinterpret_cast<float*>(value)[c];
    sum += left * from[c];
    if (right != 0) sum += right * from[values.channels + c];
  }
}

// The four pixels around each point on two neighboring levels, and their shares in its value.
struct Taps {
  const Record* record;
  float wanted[BLOCK];       // not 0 if the photograph matters at the point
  int32_t place[4][BLOCK];   // of the left pixels above and below, on the finer level and the other
  float share[8][BLOCK];     // of each of these, and of the one to its right
};

// Finds the pixels on one of the levels, at points of a mask.
inline void find_pixels(const LevelPair& pair, int level, V x, V y, V share, M at, int j, Taps& taps) {
  I first[2], other;  // of the pixels before, and whether there is another one behind
  V before[2], after[2];
  for (int axis = 0; axis < 2; axis++) {
    const int i = 2 * level + axis;
    const V most = broadcast(pair.most[i]);
    V pixel = mad(axis ? y : x, broadcast(pair.focal[i]), broadcast(pair.center[i] - .5f));
    pixel = lesser(greater(pixel, broadcast(-2)), broadcast(0x1p20f));  // also if not a number
    const V corner = __builtin_convertvector(floor_of(pixel), V);
    const M between = at_most(V{}, corner) & less(corner, most);
    after[axis] = select(between, pixel - corner);
    before[axis] = 1.f - after[axis];
    first[axis] = __builtin_convertvector(lesser(greater(corner, V{}), most), I);
    if (axis) other = (I)select(between, (V)(I{} + pair.width[level]));
  }
  const I top = pair.start[level] + first[1] * pair.width[level] + first[0], bottom = top + other;
  const V above = share * before[1], below = share * after[1];
  const V shares[4] = {above * before[0], above * after[0], below * before[0], below * after[0]};
  float* places[2] = {(float*)taps.place[2 * level] + j, (float*)taps.place[2 * level + 1] + j};
  store(places[0], select(at, (V)top, load(places[0])));
  store(places[1], select(at, (V)bottom, load(places[1])));
  for (int k = 0; k < 4; k++) {
    float* to = taps.share[4 * level + k] + j;
    store(to, select(at, shares[k], load(to)));
  }
}

// Where a group of parts is read.
struct Group {
  bool own[MOST_PARTS];
  float finer;
};

// Finds what has to be read of a photograph, and fetches it; returns whether that is anything.
bool find_taps(const Job& job, const Points& points, const Workspace& work, const Group& group, const Record& record,
               int bytes, const char* values, Taps& taps) {
  const Photograph& of = job.photograph[record.photograph];
  const LevelPair* pairs = job.pairs + record.photograph * job.levels;
  bool found = false;
  taps.record = &record;
  for (int j = 0; j < points.count; j += WIDTH) {
    M wanted = less(broadcast(1), V{});
    for (int k = 0; k < job.parts; k++)
      if (group.own[k])
        wanted = wanted | less(NEGLIGIBLE * load(work.parts[k].weight + j), load(record.weight[k] + j));
    store(taps.wanted + j, select(wanted, broadcast(1)));
    if (!any(wanted)) continue;
    found = true;
    const V coarser = -load(record.size + j) - group.finer;
    V level = V{};
    for (int l = 0; l + 1 < job.levels; l++) {
      const float step = of.coarseness[l + 1] - of.coarseness[l];
      level += lesser(greater((coarser - of.coarseness[l]) / step, V{}), broadcast(1));
    }
    level = select(wanted, greater(level, broadcast(job.finest)), broadcast(job.finest));
    const V whole = __builtin_convertvector(__builtin_convertvector(level, I), V);
    const V x = load(record.ray[0] + j), y = load(record.ray[1] + j), share = level - whole;
    // Neighboring points mostly lie between the same two levels.
    for (int l = job.finest; l < job.levels; l++) {
      const M at = equal(whole, broadcast(l)) & wanted;
      if (!any(at)) continue;
      find_pixels(pairs[l], 0, x, y, 1.f - share, at, j, taps);
      find_pixels(pairs[l], 1, x, y, share, at, j, taps);
    }
    for (int p = j; p < j + WIDTH; p++)
      if (taps.wanted[p] != 0)
        for (int i = 0; i < 4; i++) __builtin_prefetch(values + int64_t(taps.place[i][p]) * bytes);
  }
  return found;
}

template <typename T>
inline float unit_of() {
  return sizeof(T) > 1 ? 1.f : T(-1) < T(0) ? 1 / 127.f : 1 / 255.f;
}

// Lowers the weights with which a point's robust parts count, where their values differ from the mean.
template <typename T>
inline void weigh_again(const Job& job, const Group& group, const Workspace& work, int p, const Channels* value,
                        float* weight) {
  const int each = job.part_channels();
  const float *mean = work.values + p * job.vectors() * LANES, *read = reinterpret_cast<const float*>(value);
  for (int k = 0; k < job.parts; k++) {
    if (!group.own[k]) continue;
    float apart = 0;
    for (int c = k * each; c < (k + 1) * each; c++) {
      const float off = unit_of<T>() * read[c] - mean[c];
      apart += off * off;
    }
    const float variance = work.parts[k].variance[p];
    const float odd = variance == 0 ? 1 : 1 + job.settings[k].robust * (apart / each) / variance;
    weight[k] /= odd * odd;
  }
}

// Reads what a photograph shows and adds it by its weights; `again` for robust parts alone.
template <typename T, int VECTORS>
void add_photograph(const Job& job, const Points& points, Workspace& work, const Group& group, const Values<T>& values,
                    const Taps& taps, bool again) {
  constexpr int MOST = VECTORS ? VECTORS : MOST_CHANNELS / LANES;
  const int vectors = VECTORS ? VECTORS : job.vectors(), each = job.part_channels(), parts = job.parts;
  float *sums = again ? work.robust : work.values, *squares = work.squares;
  const Record& record = *taps.record;
  Channels lanes[MOST_PARTS][MOST];  // 1 in the channels of a part
  for (int k = 0; k < parts; k++)
    for (int c = 0; c < vectors * LANES; c++) lanes[k][c / LANES][c % LANES] = group.own[k] && c / each == k;
  for (int p = 0; p < points.count; p++) {
    if (taps.wanted[p] == 0) continue;
    Channels value[MOST];
    for (int v = 0; v < vectors; v++) value[v] = Channels{};
    const int most = taps.share[4][p] + taps.share[5][p] + taps.share[6][p] + taps.share[7][p] > 0 ? 4 : 2;
    for (int i = 0; i < most; i++)
      add_pixels(values, taps.place[i][p], taps.share[2 * i][p], taps.share[2 * i + 1][p], vectors, value);
    float weight[MOST_PARTS] = {};
    for (int k = 0; k < parts; k++) weight[k] = record.weight[k][p];
    if (again) {
      weigh_again<T>(job, group, work, p, value, weight);
      for (int k = 0; k < parts; k++) work.robust_weight[k][p] += group.own[k] ? weight[k] : 0;
    }
    for (int v = 0; v < vectors; v++) {
      Channels share = weight[0] * lanes[0][v], sum;
      for (int k = 1; k < parts; k++) share = add_product(Channels{} + weight[k], lanes[k][v], share);
      const int place = (p * vectors + v) * LANES;
      const Channels weighted = share * value[v];
      std::memcpy(&sum, sums + place, sizeof sum);
      sum += weighted;
      std::memcpy(sums + place, &sum, sizeof sum);
      if (again) continue;
      std::memcpy(&sum, squares + place, sizeof sum);
      sum = add_product(weighted, value[v], sum);
      std::memcpy(squares + place, &sum, sizeof sum);
    }
  }
}

// Adds what the recorded photographs show. VECTORS is the number of vectors of channels, or 0 for any.
template <typename T, int VECTORS>
void add_values(const Job& job, const Points& points, Workspace& work, int records, bool again) {
  const T* first = static_cast<const T*>(job.values);
  const Values<T> values = {first, first + job.pixels * job.channels, job.channels};
  for (int head = 0; head < job.parts; head++) {
    // Parts that are read alike are read together, with the first of them.
    Group group;
    group.finer = job.settings[head].finer;
    bool is_first = true, some = false;
    for (int k = 0; k < job.parts; k++) {
      const bool alike = job.settings[k].finer == group.finer;
      group.own[k] = alike && (!again || job.settings[k].robust != 0);
      is_first = is_first && !(k < head && alike);
      some = some || group.own[k];
    }
    if (!is_first || !some) continue;
    // Memory is slow: while one photograph is read, the next one's pixels are on their way.
    Taps taps[2];
    int now = 0;
    bool ready = false;
    for (int i = 0; i <= records; i++) {
      bool next = false;
      if (i < records) {
        const Record& record = work.records[i];
        const char* from = reinterpret_cast<const char*>(first);
        next = find_taps(job, points, work, group, record, job.channels * sizeof(T), from, taps[1 - now]);
        if (!next) continue;
      }
      if (ready) add_photograph<T, VECTORS>(job, points, work, group, values, taps[now], again);
      ready = next;
      now = 1 - now;
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
