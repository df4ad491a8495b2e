// Projects surfels, and its derivative: `projection.py`, `disc_box.py`, `filters.py` and
// `spherical_harmonics.py` for a vector of surfels at once.
//
// Compiled once for each instruction set, see `splat_tiles.cc`.
#include <cmath>

#include "splat_surfels.h"
#include "isa.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

constexpr float EDGE_ON = 1e-4f, MAX_LOG_SCALE = 30.f, LOW_PASS_VALUE = 2.f, NO_LOW_PASS = 1e9f;
constexpr float PIXEL_VARIANCE = 1.f / 12;

struct Vector {
  V x, y, z;
};
inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator*(V s, Vector a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vector select(M mask, Vector a) { return {select(mask, a.x), select(mask, a.y), select(mask, a.z)}; }
inline V dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(Vector a, Vector b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Rows begin, begin + 1, ... of an array [N, columns]; rows past the end repeat the last.
inline void read_rows(const float* array, int columns, int begin, int lanes, V* to) {
  float values[MOST_HARMONICS * 3][WIDTH];
  for (int k = 0; k < WIDTH; k++) {
    const float* row = array + static_cast<long>(begin + (k < lanes ? k : lanes - 1)) * columns;
    for (int i = 0; i < columns; i++) values[i][k] = row[i];
  }
  for (int i = 0; i < columns; i++) to[i] = load(values[i]);
}
inline void write_rows(float* array, int columns, int begin, int lanes, const V* from) {
  float values[MOST_HARMONICS * 3][WIDTH];
  for (int i = 0; i < columns; i++) store(values[i], from[i]);
  for (int k = 0; k < lanes; k++) {
    float* row = array + static_cast<long>(begin + k) * columns;
    for (int i = 0; i < columns; i++) row[i] = values[i][k];
  }
}
inline Vector vector_of(const V* v) { return {v[0], v[1], v[2]}; }

// The camera's axes in the world, and its numbers.
struct Axes {
  V axis[3][3], position[3], focal[2], principal[2];

  explicit Axes(const View& view) {
    for (int j = 0; j < 3; j++)
      for (int i = 0; i < 3; i++) axis[j][i] = broadcast(view.camtoworld[4 * i + j]);
    for (int i = 0; i < 3; i++) position[i] = broadcast(view.camtoworld[4 * i + 3]);
    for (int i = 0; i < 2; i++) {
      focal[i] = broadcast(view.intrinsics[i]);
      principal[i] = broadcast(view.intrinsics[2 + i]);
    }
  }

  Vector turn(Vector v) const {
    return {dot(vector_of(axis[0]), v), dot(vector_of(axis[1]), v), dot(vector_of(axis[2]), v)};
  }
  Vector turn_back(Vector v) const {
    return v.x * vector_of(axis[0]) + v.y * vector_of(axis[1]) + v.z * vector_of(axis[2]);
  }
};

// Orthonormal harmonics at unit directions, and the gradient of a sum of them.
struct Harmonics {
  V values[MOST_HARMONICS];

  static constexpr float C0 = .28209479f, A = .48860251f, B = 1.0925484f, C = .31539157f, D = .54627422f;
  static constexpr float E = .59004359f, F = 2.8906114f, G = .45704580f, H = .37317633f, K = 1.4453057f;

  Harmonics(Vector d, int count) {
    const V x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    values[0] = broadcast(C0);
    if (count > 1) {
      values[1] = -A * y;
      values[2] = A * z;
      values[3] = -A * x;
    }
    if (count > 4) {
      values[4] = B * x * y;
      values[5] = -B * y * z;
      values[6] = C * (2.f * zz - xx - yy);
      values[7] = -B * x * z;
      values[8] = D * (xx - yy);
    }
    if (count > 9) {
      values[9] = -E * y * (3.f * xx - yy);
      values[10] = F * x * y * z;
      values[11] = -G * y * (4.f * zz - xx - yy);
      values[12] = H * z * (2.f * zz - 3.f * xx - 3.f * yy);
      values[13] = -G * x * (4.f * zz - xx - yy);
      values[14] = K * z * (xx - yy);
      values[15] = -E * x * (xx - 3.f * yy);
    }
  }

  // The cotangent of the direction from those of the functions.
  static Vector pull_back(Vector d, int count, const V* b) {
    const V x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    Vector g = {V{}, V{}, V{}};
    if (count > 1) g = {-A * b[3], -A * b[1], A * b[2]};
    if (count > 4) {
      g.x = g.x + B * y * b[4] - 2.f * C * x * b[6] - B * z * b[7] + 2.f * D * x * b[8];
      g.y = g.y + B * x * b[4] - B * z * b[5] - 2.f * C * y * b[6] - 2.f * D * y * b[8];
      g.z = g.z - B * y * b[5] + 4.f * C * z * b[6] - B * x * b[7];
    }
    if (count > 9) {
      g.x = g.x - 6.f * E * x * y * b[9] + F * y * z * b[10] + 2.f * G * x * y * b[11] - 6.f * H * x * z * b[12] -
            G * (4.f * zz - 3.f * xx - yy) * b[13] + 2.f * K * x * z * b[14] - 3.f * E * (xx - yy) * b[15];
      g.y = g.y - 3.f * E * (xx - yy) * b[9] + F * x * z * b[10] - G * (4.f * zz - xx - 3.f * yy) * b[11] -
            6.f * H * y * z * b[12] + 2.f * G * x * y * b[13] - 2.f * K * y * z * b[14] + 6.f * E * x * y * b[15];
      g.z = g.z + F * x * y * b[10] - 8.f * G * y * z * b[11] + H * (6.f * zz - 3.f * xx - 3.f * yy) * b[12] -
            8.f * G * x * z * b[13] + K * (xx - yy) * b[14];
    }
    return g;
  }
};

// Surfels in the camera's frame, and their homographies, as far as derivatives need them.
struct Discs {
  Vector offset, u_world, v_world, n_world;  // the rotation's columns
  Vector mu, u, v, n;                        // the same in the camera's frame
  V q[4], norm, scale[2];
  M no_norm, unclipped[2];
  M away, ahead, centered, edge_on;
  V inverse_depth, center[2], anchor[2], per_facing, ray[2];
  Vector plain[3], rows[3];  // covectors of u / z, v / z, 1 / z; and homographies without a filter
  // With antialiasing, the factor of the spread, and the filtered rows.
  M known;
  V slopes[4], first, below, second, crossed;
  Vector filtered[2];

  Discs(const Surfels& surfels, const View& view, const Axes& axes, int begin, int lanes) {
    V raw[4];
    read_rows(surfels.quaternions, 4, begin, lanes, raw);
    const V length = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3];
    no_norm = equal(length, V{});
    norm = root(select(no_norm, broadcast(1), length));
    for (int i = 0; i < 4; i++) q[i] = raw[i] / norm;
    const V w = q[0], x = q[1], y = q[2], z = q[3];
    u_world = {1.f - 2.f * (y * y + z * z), 2.f * (x * y + w * z), 2.f * (x * z - w * y)};
    v_world = {2.f * (x * y - w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z + w * x)};
    n_world = {2.f * (x * z + w * y), 2.f * (y * z - w * x), 1.f - 2.f * (x * x + y * y)};
    V mean[3], logs[2];
    read_rows(surfels.means, 3, begin, lanes, mean);
    read_rows(surfels.log_scales, 2, begin, lanes, logs);
    offset = {mean[0] - axes.position[0], mean[1] - axes.position[1], mean[2] - axes.position[2]};
    away = less(V{}, dot(offset, n_world));
    mu = axes.turn(offset);
    u = axes.turn(u_world);
    v = axes.turn(v_world);
    n = axes.turn(n_world);
    const V most = broadcast(MAX_LOG_SCALE);
    for (int i = 0; i < 2; i++) {
      unclipped[i] = less(logs[i], most) & less(-most, logs[i]);
      scale[i] = exponential(lesser(most, greater(-most, logs[i])));
    }
    place(view, axes);
    make_rows(axes);
  }

  // Where the center lies in the image, and the anchor about which numbers are taken.
  void place(const View& view, const Axes& axes) {
    ahead = less(broadcast(view.near), mu.z);
    inverse_depth = 1.f / select(ahead, mu.z, broadcast(1));
    const V along[2] = {mu.x, mu.y};
    const int size[2] = {view.width, view.height};
    centered = ahead;
    for (int i = 0; i < 2; i++) {
      center[i] = along[i] * inverse_depth * axes.focal[i] + axes.principal[i];
      const V margin = broadcast(size[i] > 16 ? size[i] : 16);
      centered = centered & less(-margin, center[i]) & less(center[i], broadcast(size[i]) + margin);
    }
    for (int i = 0; i < 2; i++) {
      const V margin = broadcast(size[i] > 16 ? size[i] : 16);
      // Discs behind the camera are anchored at a corner of pixels, never at a pixel's center.
      const V clipped = lesser(greater(center[i], -margin), broadcast(size[i]) + margin);
      const V elsewhere = select(ahead, clipped, broadcast(size[i] / 2));
      anchor[i] = select(centered, center[i], elsewhere);
      ray[i] = (anchor[i] - axes.principal[i]) / axes.focal[i];
    }
  }

  void make_rows(const Axes& axes) {
    const V facing = dot(n, mu);
    const V size = facing < 0.f ? -facing : facing;
    edge_on = ~less(EDGE_ON * root(dot(mu, mu)), size);
    per_facing = 1.f / select(edge_on, broadcast(1), facing);
    plain[0] = (per_facing / scale[0]) * cross(v, mu);
    plain[1] = (per_facing / scale[1]) * cross(mu, u);
    plain[2] = per_facing * n;
    const V at_center[3] = {V{}, V{}, inverse_depth};
    for (int i = 0; i < 3; i++) {
      const Vector c = plain[i];
      const V there = c.x * ray[0] + c.y * ray[1] + c.z;
      rows[i] = {select(centered, at_center[i], there), c.x / axes.focal[0], c.y / axes.focal[1]};
    }
  }

  // The convolution with the pixel, see `filters.pixel_spread` and `widen`.
  void filter() {
    known = centered & ~edge_on;
    const V raw[4] = {rows[0].y, rows[0].z, rows[1].y, rows[1].z};
    for (int i = 0; i < 4; i++) slopes[i] = select(known, mu.z * raw[i]);
    const V ux = slopes[0], uy = slopes[1], vx = slopes[2], vy = slopes[3];
    const V uu = PIXEL_VARIANCE * (ux * ux + uy * uy), uv = PIXEL_VARIANCE * (ux * vx + uy * vy);
    const V vv = PIXEL_VARIANCE * (vx * vx + vy * vy);
    first = root(1.f + uu);
    below = uv / first;
    crossed = PIXEL_VARIANCE * (ux * vy - vx * uy);
    second = root((1.f + uu + vv + crossed * crossed) / (1.f + uu));
    filtered[0] = (1.f / first) * rows[0];
    filtered[1] = (1.f / second) * (rows[1] + (-below) * filtered[0]);
  }
};

// Both points (cos, sin) with a cos + b sin + c = 0; see `disc_box`.
struct Points {
  V cos[2], sin[2];
  M exist;

  Points(V a, V b, V c) {
    const auto size = [](V x) { return x < 0.f ? -x : x; };
    const V largest = greater(greater(size(a), size(b)), greater(size(c), broadcast(1e-30f)));
    a = a / largest;
    b = b / largest;
    c = c / largest;
    const V sum = a * a + b * b, discriminant = sum - c * c, half = root(greater(discriminant, V{}));
    const V divisor = select(equal(sum, V{}), broadcast(1), sum);
    for (int i = 0; i < 2; i++) {
      const float s = i ? 1.f : -1.f;
      cos[i] = (-c * a - s * b * half) / divisor;
      sin[i] = (-c * b + s * a * half) / divisor;
    }
    exist = at_most(V{}, discriminant);
  }
};

// Exact bounds x0, y0, x1, y1 of discs, also of those that reach through the near plane.
void find_box(const Vector& mu, const Vector* vectors, V cutoff, const Axes& axes, float near, V* box) {
  const V radius = 1.001f * cutoff, infinite = broadcast(INFINITY);
  const Vector a = radius * vectors[0], b = radius * vectors[1];
  const V circle[3][3] = {{a.x, b.x, mu.x}, {a.y, b.y, mu.y}, {a.z, b.z, mu.z}};
  const V* depth = circle[2];
  const auto at = [](const V* coordinate, V cos, V sin) { return coordinate[0] * cos + coordinate[1] * sin + coordinate[2]; };
  const Points chord(depth[0], depth[1], depth[2] - near);
  for (int axis = 0; axis < 2; axis++) {
    const V* own = circle[axis];
    V least = infinite, most = -infinite;
    const auto include = [&](V value, V depth_there, M exists) {
      const V there = value / depth_there * axes.focal[axis] + axes.principal[axis];
      least = lesser(select(exists, there, infinite), least);
      most = greater(select(exists, there, -infinite), most);
    };
    for (int i = 0; i < 2; i++) include(at(own, chord.cos[i], chord.sin[i]), broadcast(near), chord.exist);
    // The derivative of own / depth vanishes.
    const Vector stationary = cross({own[0], own[1], own[2]}, {depth[0], depth[1], depth[2]});
    const Points rim(stationary.x, stationary.y, -stationary.z);
    for (int i = 0; i < 2; i++) {
      const V there = at(depth, rim.cos[i], rim.sin[i]);
      const M exists = rim.exist & at_most(broadcast(near), there);
      include(at(own, rim.cos[i], rim.sin[i]), select(exists, there, broadcast(1)), exists);
    }
    box[axis] = least - .01f;
    box[2 + axis] = most + .01f;
  }
}

// Where the colors of surfels are seen from, and their harmonics.
struct Colors {
  V distance;
  Vector direction;
  M at_camera;

  explicit Colors(Vector offset) {
    const V square = dot(offset, offset);
    at_camera = equal(square, V{});
    distance = root(select(at_camera, broadcast(1), square));
    direction = {offset.x / distance, offset.y / distance, offset.z / distance};
  }
};

void project_some(const Surfels& surfels, const View& view, const Axes& axes, int begin, int lanes, const Projected& out) {
  Discs discs(surfels, view, axes, begin, lanes);
  V opacity;
  read_rows(surfels.opacity, 1, begin, lanes, &opacity);
  Vector vectors[2] = {discs.scale[0] * discs.u, discs.scale[1] * discs.v};
  if (view.antialias) {
    discs.filter();
    vectors[0] = discs.first * vectors[0] + discs.below * vectors[1];
    vectors[1] = discs.second * vectors[1];
    opacity = opacity / (discs.first * discs.second);
  }
  const V cutoff = root(2.f * logarithm(greater(opacity / ALPHA_MIN, broadcast(1))));
  const V reach = cutoff * root(squared(vectors[0].z) + squared(vectors[1].z)), near = broadcast(view.near);
  const M drawn = ~discs.edge_on & at_most(broadcast(ALPHA_MIN), opacity) & at_most(near, discs.mu.z + reach);
  V box[4]{};
  if (any(drawn)) {
    find_box(discs.mu, vectors, cutoff, axes, view.near, box);
    if (!view.antialias) {
      const V half = 1.001f * cutoff / std::sqrt(LOW_PASS_VALUE) + .01f;
      for (int i = 0; i < 2; i++) {
        box[i] = select(discs.ahead, lesser(box[i], discs.center[i] - half), box[i]);
        box[2 + i] = select(discs.ahead, greater(box[2 + i], discs.center[i] + half), box[2 + i]);
      }
    }
  }
  const M shows = drawn & at_most(broadcast(0), box[2]) & at_most(broadcast(0), box[3]) &
                  at_most(box[0], broadcast(view.width)) & at_most(box[1], broadcast(view.height));
  if (!any(shows)) {
    for (long i = 4L * begin; i < 4L * (begin + lanes); i++) out.box[i] = -1;
    return;
  }
  for (int i = 0; i < 4; i++) box[i] = select(shows, box[i], broadcast(-1));
  write_rows(out.box, 4, begin, lanes, box);
  const V order = greater(discs.mu.z, near);
  write_rows(out.order, 1, begin, lanes, &order);
  V row[COLUMNS];
  for (int i = 0; i < 2; i++) row[ANCHOR + i] = discs.anchor[i];
  const Vector* h = view.antialias ? discs.filtered : discs.rows;
  for (int i = 0; i < 3; i++) {
    const Vector own = i < 2 ? h[i] : discs.rows[2];
    row[HOMOGRAPHY + 3 * i] = own.x;
    row[HOMOGRAPHY + 3 * i + 1] = own.y;
    row[HOMOGRAPHY + 3 * i + 2] = own.z;
  }
  row[OPACITY] = select(drawn, opacity);
  row[LOW_PASS] = view.antialias ? broadcast(NO_LOW_PASS) : select(discs.ahead, broadcast(LOW_PASS_VALUE), broadcast(NO_LOW_PASS));
  row[INVERSE_DEPTH] = 1.f / greater(discs.mu.z + reach, near);
  row[INVERSE_DEPTH + 1] = 1.f / greater(discs.mu.z - reach, near);
  const Colors colors(discs.offset);
  const Harmonics basis(colors.direction, surfels.harmonics);
  V sh[MOST_HARMONICS * 3];
  read_rows(surfels.sh, 3 * surfels.harmonics, begin, lanes, sh);
  for (int c = 0; c < 3; c++) {
    V sum = broadcast(.5f);
    for (int k = 0; k < surfels.harmonics; k++) sum = mad(basis.values[k], sh[3 * k + c], sum);
    row[PAYLOAD + c] = greater(sum, V{});
  }
  const V sign = select(discs.away, broadcast(-1), broadcast(1));
  row[PAYLOAD + 3] = sign * discs.n_world.x;
  row[PAYLOAD + 4] = sign * discs.n_world.y;
  row[PAYLOAD + 5] = sign * discs.n_world.z;
  write_rows(out.table, COLUMNS, begin, lanes, row);
}

// Cotangents of the camera, summed over surfels.
struct CameraBar {
  V axis[3][3], position[3], focal[2], principal[2];

  // Numbers of surfels that do not show may not be finite.
  void add(M shows, const CameraBar& other) {
    const auto more = [shows](V& sum, V part) { sum = sum + select(shows, part); };
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) more(axis[j][i], other.axis[j][i]);
      more(position[i], other.position[i]);
    }
    for (int i = 0; i < 2; i++) {
      more(focal[i], other.focal[i]);
      more(principal[i], other.principal[i]);
    }
  }
};

// Cotangents of what `Discs` holds, filled from the back.
struct DiscBars {
  Vector mu{}, u{}, v{}, n{}, rows[3]{}, plain[3]{};
  V scale[2]{}, inverse_depth{}, depth{}, per_facing{}, first{}, second{}, below{};

  // See `Discs::filter`; `opacity` is the filtered one, `opacity_bar` its cotangent.
  void pull_filter(const Discs& d, const Vector* filtered_bar, V opacity, V opacity_bar) {
    first = -opacity_bar * opacity / d.first;
    second = -opacity_bar * opacity / d.second;
    rows[1] = (1.f / d.second) * filtered_bar[1];
    second = second - dot(filtered_bar[1], d.filtered[1]) / d.second;
    below = -dot(rows[1], d.filtered[0]);
    const Vector u_bar = filtered_bar[0] + (-d.below) * rows[1];
    rows[0] = (1.f / d.first) * u_bar;
    first = first - dot(u_bar, d.filtered[0]) / d.first;
    // second^2 = q / p, where p = first^2.
    const V p = d.first * d.first, q_bar = second / (2.f * d.second * p), p_bar = -second * d.second / (2.f * p);
    const V uv_bar = PIXEL_VARIANCE * below / d.first;
    first = first - below * d.below / d.first;
    const V uu_bar = PIXEL_VARIANCE * 2.f * (q_bar + p_bar + first / (2.f * d.first));
    const V vv_bar = PIXEL_VARIANCE * 2.f * q_bar, crossed_bar = PIXEL_VARIANCE * 2.f * d.crossed * q_bar;
    const V ux = d.slopes[0], uy = d.slopes[1], vx = d.slopes[2], vy = d.slopes[3];
    const V bars[4] = {ux * uu_bar + vx * uv_bar + vy * crossed_bar, uy * uu_bar + vy * uv_bar - vx * crossed_bar,
                       vx * vv_bar + ux * uv_bar - uy * crossed_bar, vy * vv_bar + uy * uv_bar + ux * crossed_bar};
    V* slots[4] = {&rows[0].y, &rows[0].z, &rows[1].y, &rows[1].z};
    const V raw[4] = {d.rows[0].y, d.rows[0].z, d.rows[1].y, d.rows[1].z};
    for (int i = 0; i < 4; i++) {
      const V bar = select(d.known, bars[i]);
      *slots[i] = *slots[i] + bar * d.mu.z;
      depth = depth + bar * raw[i];
    }
  }

  // See `Discs::make_rows`.
  void pull_rows(const Discs& d, const Axes& axes, CameraBar* camera) {
    inverse_depth = select(d.centered, rows[2].x);
    for (int i = 0; i < 3; i++) {
      const V there = select(~d.centered, rows[i].x), x = rows[i].y / axes.focal[0], y = rows[i].z / axes.focal[1];
      plain[i] = {x + there * d.ray[0], y + there * d.ray[1], there};
      if (camera) {
        const V ray_bar[2] = {there * d.plain[i].x, there * d.plain[i].y}, slope_bar[2] = {x, y};
        const V slope[2] = {d.rows[i].y, d.rows[i].z};
        for (int k = 0; k < 2; k++) {
          // The anchor of a disc that is not centered has no derivative.
          camera->principal[k] = camera->principal[k] - ray_bar[k] / axes.focal[k];
          camera->focal[k] = camera->focal[k] - ray_bar[k] * d.ray[k] / axes.focal[k] - slope_bar[k] * slope[k];
        }
      }
    }
    const V per_u = d.per_facing / d.scale[0], per_v = d.per_facing / d.scale[1];
    const V per_u_bar = dot(plain[0], cross(d.v, d.mu)), per_v_bar = dot(plain[1], cross(d.mu, d.u));
    const Vector a = per_u * plain[0], b = per_v * plain[1];
    v = v + cross(d.mu, a);
    mu = mu + cross(a, d.v) + cross(d.u, b);
    u = u + cross(b, d.mu);
    n = n + d.per_facing * plain[2];
    per_facing = per_u_bar / d.scale[0] + per_v_bar / d.scale[1] + dot(plain[2], d.n);
    scale[0] = -per_u_bar * per_u / d.scale[0];
    scale[1] = -per_v_bar * per_v / d.scale[1];
    const V facing = select(~d.edge_on, -d.per_facing * d.per_facing * per_facing);
    n = n + facing * d.mu;
    mu = mu + facing * d.n;
  }

  // See `Discs::place`.
  void pull_center(const Discs& d, const Axes& axes, const V* anchor_bar, CameraBar* camera) {
    V* along[2] = {&mu.x, &mu.y};
    const V at[2] = {d.mu.x, d.mu.y};
    for (int i = 0; i < 2; i++) {
      const V bar = select(d.centered, anchor_bar[i]);
      *along[i] = *along[i] + bar * d.inverse_depth * axes.focal[i];
      inverse_depth = inverse_depth + bar * at[i] * axes.focal[i];
      if (camera) {
        camera->focal[i] = camera->focal[i] + bar * at[i] * d.inverse_depth;
        camera->principal[i] = camera->principal[i] + bar;
      }
    }
    mu.z = mu.z + depth - select(d.ahead, d.inverse_depth * d.inverse_depth * inverse_depth);
  }
};

// The cotangent of unnormalized quaternions from those of the rotation's columns.
void pull_quaternion(const Discs& d, Vector u, Vector v, Vector n, V* bar) {
  const V w = d.q[0], x = d.q[1], y = d.q[2], z = d.q[3];
  const V unit[4] = {
      2.f * (-z * v.x + y * n.x + z * u.y - x * n.y - y * u.z + x * v.z),
      2.f * (y * v.x + z * n.x + y * u.y - 2.f * x * v.y - w * n.y + z * u.z + w * v.z - 2.f * x * n.z),
      2.f * (-2.f * y * u.x + x * v.x + w * n.x + x * u.y + z * n.y - w * u.z + z * v.z - 2.f * y * n.z),
      2.f * (-2.f * z * u.x - w * v.x + x * n.x + w * u.y - 2.f * z * v.y + y * n.y + x * u.z + y * v.z)};
  const V along = unit[0] * w + unit[1] * x + unit[2] * y + unit[3] * z;
  for (int i = 0; i < 4; i++) bar[i] = (unit[i] - select(~d.no_norm, d.q[i] * along)) / d.norm;
}

// Adds the camera's cotangent through a vector that was turned into its frame.
void add_turned(CameraBar* camera, Vector world, Vector bar) {
  const V bars[3] = {bar.x, bar.y, bar.z}, own[3] = {world.x, world.y, world.z};
  for (int j = 0; j < 3; j++)
    for (int i = 0; i < 3; i++) camera->axis[j][i] = camera->axis[j][i] + bars[j] * own[i];
}

void pull_some(const Surfels& surfels, const View& view, const Axes& axes, int begin, int lanes, const float* table_bar,
               M shows, const SurfelBars& out, CameraBar* all_cameras) {
  CameraBar own_camera{}, *camera = all_cameras ? &own_camera : nullptr;
  Discs d(surfels, view, axes, begin, lanes);
  V row[COLUMNS];
  read_rows(table_bar, COLUMNS, begin, lanes, row);
  for (V& value : row) value = select(shows, value);  // rows that do not show were not written
  const auto row_of = [&](int i) { return vector_of(row + HOMOGRAPHY + 3 * i); };
  DiscBars bars;
  bars.rows[2] = row_of(2);
  V opacity_bar = row[OPACITY];
  if (view.antialias) {
    V opacity;
    read_rows(surfels.opacity, 1, begin, lanes, &opacity);
    d.filter();
    const Vector filtered_bar[2] = {row_of(0), row_of(1)};
    const V both = d.first * d.second;
    bars.pull_filter(d, filtered_bar, opacity / both, opacity_bar);
    opacity_bar = opacity_bar / both;
  } else {
    bars.rows[0] = row_of(0);
    bars.rows[1] = row_of(1);
  }
  bars.pull_rows(d, axes, camera);
  bars.pull_center(d, axes, row + ANCHOR, camera);

  const Colors colors(d.offset);
  const Harmonics basis(colors.direction, surfels.harmonics);
  const int terms = surfels.harmonics;
  V sh[MOST_HARMONICS * 3], basis_bar[MOST_HARMONICS]{};
  read_rows(surfels.sh, 3 * terms, begin, lanes, sh);
  for (int c = 0; c < 3; c++) {
    V sum = broadcast(.5f);
    for (int k = 0; k < terms; k++) sum = mad(basis.values[k], sh[3 * k + c], sum);
    const V bar = select(less(V{}, sum), row[PAYLOAD + c]);
    for (int k = 0; k < terms; k++) {
      basis_bar[k] = mad(sh[3 * k + c], bar, basis_bar[k]);
      sh[3 * k + c] = basis.values[k] * bar;
    }
  }
  const Vector toward = Harmonics::pull_back(colors.direction, terms, basis_bar);
  const V along = select(~colors.at_camera, dot(toward, colors.direction));
  Vector offset_bar = (1.f / colors.distance) * (toward + (-along) * colors.direction);

  const V sign = select(d.away, broadcast(-1), broadcast(1));
  const Vector seen_bar = sign * vector_of(row + PAYLOAD + 3);
  offset_bar = offset_bar + axes.turn_back(bars.mu);
  V quaternion_bar[4], scale_bar[2];
  pull_quaternion(d, axes.turn_back(bars.u), axes.turn_back(bars.v), axes.turn_back(bars.n) + seen_bar, quaternion_bar);
  for (int i = 0; i < 2; i++) scale_bar[i] = select(d.unclipped[i] & shows, bars.scale[i] * d.scale[i]);
  // Numbers of surfels that do not show may not be finite.
  const Vector mean_bar = select(shows, offset_bar);
  const V mean_bars[3] = {mean_bar.x, mean_bar.y, mean_bar.z};
  for (V& value : quaternion_bar) value = select(shows, value);
  opacity_bar = select(shows, opacity_bar);
  for (int i = 0; i < 3 * terms; i++) sh[i] = select(shows, sh[i]);
  write_rows(out.means, 3, begin, lanes, mean_bars);
  write_rows(out.log_scales, 2, begin, lanes, scale_bar);
  write_rows(out.quaternions, 4, begin, lanes, quaternion_bar);
  write_rows(out.opacity, 1, begin, lanes, &opacity_bar);
  write_rows(out.sh, 3 * terms, begin, lanes, sh);
  if (camera) {
    add_turned(camera, d.offset, bars.mu);
    add_turned(camera, d.u_world, bars.u);
    add_turned(camera, d.v_world, bars.v);
    add_turned(camera, d.n_world, bars.n);
    for (int i = 0; i < 3; i++) camera->position[i] = -mean_bars[i];
    all_cameras->add(shows, own_camera);
  }
}

void project(const Surfels& surfels, const View& view, int begin, int end, const Projected& out) {
  const Axes axes(view);
  for (int i = begin; i < end; i += WIDTH) project_some(surfels, view, axes, i, end - i < WIDTH ? end - i : WIDTH, out);
}

void clear_rows(float* array, int columns, int begin, int lanes) {
  std::memset(array + static_cast<long>(begin) * columns, 0, sizeof(float) * columns * lanes);
}

void pull_back(const Surfels& surfels, const View& view, int begin, int end, const float* table_bar, const float* box,
               const SurfelBars& out, float* camera_bar) {
  const Axes axes(view);
  CameraBar camera{};
  for (int i = begin; i < end; i += WIDTH) {
    const int lanes = end - i < WIDTH ? end - i : WIDTH;
    V bounds[4];
    read_rows(box, 4, i, lanes, bounds);
    float inside[WIDTH];
    for (int k = 0; k < WIDTH; k++) inside[k] = k < lanes;  // the last lanes repeat a surfel
    const M shows = at_most(bounds[0], bounds[2]) & less(V{}, load(inside)) & less(broadcast(-1), bounds[2]);
    if (any(shows)) {
      pull_some(surfels, view, axes, i, lanes, table_bar, shows, out, camera_bar ? &camera : nullptr);
      continue;
    }
    clear_rows(out.means, 3, i, lanes);
    clear_rows(out.log_scales, 2, i, lanes);
    clear_rows(out.quaternions, 4, i, lanes);
    clear_rows(out.opacity, 1, i, lanes);
    clear_rows(out.sh, 3 * surfels.harmonics, i, lanes);
  }
  if (!camera_bar) return;
  const auto total = [](V v) {
    float sum = 0;
    for (int i = 0; i < WIDTH; i++) sum += v[i];
    return sum;
  };
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) camera_bar[4 * i + j] += total(camera.axis[j][i]);
    camera_bar[4 * i + 3] += total(camera.position[i]);
  }
  for (int i = 0; i < 2; i++) {
    camera_bar[12 + i] += total(camera.focal[i]);
    camera_bar[14 + i] += total(camera.principal[i]);
  }
}

}  // namespace

extern const Projection OF_ISA(projection_, ISA) = {project, pull_back};

}  // namespace jaxcloseup
