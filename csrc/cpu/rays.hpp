// Voxel volumes and rays: Joseph's projector with its exact adjoint, and FDK's backprojection.
#pragma once

#include "api.hpp"
#include "cpu/load.hpp"

namespace splat {
inline namespace SPLAT_NS {

// A ray in voxel indices, walked along its main axis one slice at a time.
struct IndexRay {
  int axis;           // 0 x, 1 y, 2 z: the main axis
  int first, last;    // slices, inclusive
  double start[3];    // index coordinates at slice 0 of the main axis (x, y, z)
  double step[3];     // per slice
  double length;      // mm a slice
};

// Calls body(row, column, ray) for every pixel of rows [from, to).
template <class Body>
inline void each_ray(const FrameIn& f, const GridIn& g, int rows, int cols, int from, int to, Body body) {
  const double voxel[3] = {g.voxel[2], g.voxel[1], g.voxel[0]};
  const int n[3] = {g.nx, g.ny, g.nz};
  for (int r = from; r < to; ++r) {
    for (int c = 0; c < cols; ++c) {
      double point[3], direction[3], norm = 0;
      for (int i = 0; i < 3; ++i) {
        point[i] = f.center[i] + (c - (cols - 1) / 2.0) * f.u[i] + (r - (rows - 1) / 2.0) * f.v[i];
        direction[i] = f.cone ? point[i] - f.first[i] : f.first[i];
        norm += direction[i] * direction[i];
      }
      norm = sqrt(norm);
      IndexRay ray;
      ray.axis = 0;
      double best = -1, slope[3], at[3];
      for (int i = 0; i < 3; ++i) {
        slope[i] = direction[i] / voxel[i];
        at[i] = (point[i] - g.center[i]) / voxel[i] + (n[i] - 1) / 2.0;
        if (fabs(slope[i]) > best) best = fabs(slope[i]), ray.axis = i;
      }
      const int a = ray.axis;
      for (int i = 0; i < 3; ++i) {
        ray.step[i] = slope[i] / slope[a];
        ray.start[i] = at[i] - at[a] * ray.step[i];
      }
      ray.length = norm / best;
      // Slices whose bilinear neighbourhood meets the volume.
      double low = 0, high = n[a] - 1;
      for (int i = 0; i < 3; ++i) {
        if (i == a) continue;
        const double lowest = -1, highest = n[i];
        if (fabs(ray.step[i]) < 1e-12) {
          if (ray.start[i] <= lowest || ray.start[i] >= highest) high = -1;
          continue;
        }
        double enter = (lowest - ray.start[i]) / ray.step[i], leave = (highest - ray.start[i]) / ray.step[i];
        if (enter > leave) { const double t = enter; enter = leave; leave = t; }
        if (enter > low) low = enter;
        if (leave < high) high = leave;
      }
      ray.first = static_cast<int>(ceil(low));
      ray.last = static_cast<int>(floor(high));
      body(r, c, ray);
    }
  }
}

// Four voxels around a ray in one slice, and their weights. Voxels outside a box are replaced by their nearest
// neighbour inside and get no weight, so that loops over slices have no branches.
struct Bilinear {
  long index[4];
  double weight[4];
};

// The part of a volume that may be touched, by axis (x, y, z), inclusive.
struct Box {
  int low[3], high[3];
};

class Slices {
 public:
  Slices(const GridIn& g, const IndexRay& ray, const Box& box) {
    const long pitch[3] = {1, g.nx, static_cast<long>(g.nx) * g.ny};
    const int p = ray.axis == 0 ? 1 : 0, q = ray.axis == 2 ? 1 : 2;  // the two other axes
    main_ = pitch[ray.axis], pitch_[0] = pitch[p], pitch_[1] = pitch[q];
    start_[0] = ray.start[p], start_[1] = ray.start[q], step_[0] = ray.step[p], step_[1] = ray.step[q];
    low_[0] = box.low[p], low_[1] = box.low[q], high_[0] = box.high[p], high_[1] = box.high[q];
    length_ = ray.length;
  }
  SPLAT_HD Bilinear at(int s) const {
    long place[2][2];
    double share[2][2];
    for (int a = 0; a < 2; ++a) {
      const double x = start_[a] + s * step_[a];
      const int whole = static_cast<int>(x + 1) - 1;  // floor, as x > -1
      const double rest = x - whole;
      for (int k = 0; k < 2; ++k) {
        const int j = whole + k, inside = j < low_[a] ? low_[a] : (j > high_[a] ? high_[a] : j);
        place[a][k] = inside * pitch_[a];
        share[a][k] = j == inside ? (k ? rest : 1 - rest) : 0.0;
      }
    }
    Bilinear b;
    for (int k = 0; k < 4; ++k) {
      b.index[k] = s * main_ + place[0][k & 1] + place[1][k >> 1];
      b.weight[k] = share[0][k & 1] * share[1][k >> 1] * length_;
    }
    return b;
  }

 private:
  long main_, pitch_[2];
  double start_[2], step_[2], length_;
  int low_[2], high_[2];
};

template <class T>
void project_volume(const FrameIn& f, const GridIn& g, const T* volume, int rows, int cols, T* image, int threads) {
  const Box all{{0, 0, 0}, {g.nx - 1, g.ny - 1, g.nz - 1}};
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
  for (int r = 0; r < rows; ++r) {
    each_ray(f, g, rows, cols, r, r + 1, [&](int, int c, const IndexRay& ray) {
      const Slices slices(g, ray, all);
      double sum = 0;
#pragma omp simd reduction(+ : sum)
      for (int s = ray.first; s <= ray.last; ++s) {
        const Bilinear b = slices.at(s);
        double here = 0;
        for (int k = 0; k < 4; ++k) here += b.weight[k] * volume[b.index[k]];
        sum += here;
      }
      image[static_cast<long>(r) * cols + c] = static_cast<T>(sum);
    });
  }
}

// Parallel over slabs of z: each thread walks all rays and keeps what falls into its own slices.
template <class T>
void project_volume_adjoint(const FrameIn& f, const GridIn& g, const T* image, int rows, int cols, T* volume,
                            int threads) {
  const int thick = (g.nz + 15) / 16;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int slab = 0; slab < (g.nz + thick - 1) / thick; ++slab) {
    const int z0 = slab * thick, z1 = z0 + thick < g.nz ? z0 + thick : g.nz;
    const Box own{{0, 0, z0}, {g.nx - 1, g.ny - 1, z1 - 1}};
    each_ray(f, g, rows, cols, 0, rows, [&](int r, int c, const IndexRay& ray) {
      const T value = image[static_cast<long>(r) * cols + c];
      int first = ray.first, last = ray.last;
      if (ray.axis == 2) {
        first = first > z0 ? first : z0;
        last = last < z1 - 1 ? last : z1 - 1;
      } else if (fabs(ray.step[2]) > 1e-12) {
        double a = (z0 - 1 - ray.start[2]) / ray.step[2], b = (z1 - ray.start[2]) / ray.step[2];
        if (a > b) { const double t = a; a = b; b = t; }
        if (a > first) first = a > last ? last + 1 : static_cast<int>(a);
        if (b < last) last = b < first ? first - 1 : static_cast<int>(ceil(b));
      } else if (ray.start[2] < z0 - 1 || ray.start[2] > z1) {
        return;
      }
      const Slices slices(g, ray, own);
      // Where and how much, in vectors; the adding itself is one voxel after the other.
      constexpr int kTogether = 16;
      long index[4][kTogether];
      double weight[4][kTogether];
      for (int s = first; s <= last; s += kTogether) {
        const int n = last - s < kTogether ? last - s + 1 : kTogether;
#pragma omp simd
        for (int i = 0; i < kTogether; ++i) {
          const Bilinear b = slices.at(s + i);
          for (int k = 0; k < 4; ++k) index[k][i] = b.index[k], weight[k][i] = b.weight[k] * value;
        }
        for (int i = 0; i < n; ++i)
          for (int k = 0; k < 4; ++k) volume[index[k][i]] += static_cast<T>(weight[k][i]);
      }
    });
  }
}

template <class T>
void backproject(const FrameIn& f, const GridIn& g, const T* image, int rows, int cols, double weight, T* volume,
                 int threads) {
  const View<T> view = make_view<T>(f, rows, cols);
  auto at = [](const Vec3<T>& k, double x, double y, double z) { return k.x * x + k.y * y + k.z * z; };
  const T iso = f.cone ? T(-at(view.k2, f.first[0], f.first[1], f.first[2])) : T(1);
  const double* o = f.cone ? f.first : f.center;
  // The corner of the cell that a shadow falls into is at most the last but one pixel, the last one on a single line.
  const int right = cols > 1 ? 1 : 0, down = rows > 1 ? cols : 0;
  const T last_c(cols - 1), last_r(rows - 1), corner_c(cols > 1 ? cols - 2 : 0), corner_r(rows > 1 ? rows - 2 : 0);
  const T column0 = view.column0, row0 = view.row0;
  const T du = T(view.k0.x * g.voxel[2]), dv = T(view.k1.x * g.voxel[2]);
  const T dw = f.cone ? T(view.k2.x * g.voxel[2]) : T(0);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int k = 0; k < g.nz; ++k) {
    for (int j = 0; j < g.ny; ++j) {
      const double x = g.center[0] - (g.nx - 1) / 2.0 * g.voxel[2] - o[0];
      const double y = g.center[1] + (j - (g.ny - 1) / 2.0) * g.voxel[1] - o[1];
      const double z = g.center[2] + (k - (g.nz - 1) / 2.0) * g.voxel[0] - o[2];
      const T u0 = T(at(view.k0, x, y, z)), v0 = T(at(view.k1, x, y, z)), w0 = f.cone ? T(at(view.k2, x, y, z)) : T(1);
      T* out = volume + (static_cast<long>(k) * g.ny + j) * g.nx;
#pragma omp simd
      for (int i = 0; i < g.nx; ++i) {
        // No branches: a voxel without a shadow reads the first pixel and gets none of it.
        const T depth = w0 + T(i) * dw, inverse = T(1) / depth;
        const T c = (u0 + T(i) * du) * inverse + column0, r = (v0 + T(i) * dv) * inverse + row0;
        const bool inside = (c >= T(0)) & (r >= T(0)) & (c <= last_c) & (r <= last_r) & (depth > T(0));
        const T sc = inside ? c : T(0), sr = inside ? r : T(0), gain = inside ? iso * inverse : T(0);
        const int ic = static_cast<int>(min_of(sc, corner_c)), ir = static_cast<int>(min_of(sr, corner_r));
        const T fc = sc - T(ic), fr = sr - T(ir);
        const T* p = image + (ir * cols + ic);
        const T top = p[0] + fc * (p[right] - p[0]), bottom = p[down] + fc * (p[down + right] - p[down]);
        out[i] += T(weight) * gain * gain * (top + fr * (bottom - top));
      }
    }
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
