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

// The four neighbours of the ray in slice s, and their weights; those outside the volume get none.
struct Bilinear {
  long index[4];
  double weight[4];
};

inline bool bilinear(const GridIn& g, const IndexRay& ray, int s, Bilinear& b) {
  const int p = ray.axis == 0 ? 1 : 0, q = ray.axis == 2 ? 1 : 2;  // the two other axes
  const int n[3] = {g.nx, g.ny, g.nz};
  const long pitch[3] = {1, g.nx, static_cast<long>(g.nx) * g.ny};
  const double x = ray.start[p] + s * ray.step[p], y = ray.start[q] + s * ray.step[q];
  const int ix = static_cast<int>(floor(x)), iy = static_cast<int>(floor(y));
  const double fx = x - ix, fy = y - iy;
  bool any = false;
  for (int k = 0; k < 4; ++k) {
    const int jx = ix + (k & 1), jy = iy + (k >> 1);
    const bool inside = jx >= 0 && jx < n[p] && jy >= 0 && jy < n[q];
    b.weight[k] = inside ? ((k & 1) ? fx : 1 - fx) * ((k >> 1) ? fy : 1 - fy) * ray.length : 0;
    b.index[k] = inside ? s * pitch[ray.axis] + jx * pitch[p] + jy * pitch[q] : 0;
    any |= inside;
  }
  return any;
}

template <class T>
void project_volume(const FrameIn& f, const GridIn& g, const T* volume, int rows, int cols, T* image, int threads) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
  for (int r = 0; r < rows; ++r) {
    each_ray(f, g, rows, cols, r, r + 1, [&](int, int c, const IndexRay& ray) {
      double sum = 0;
      Bilinear b;
      for (int s = ray.first; s <= ray.last; ++s)
        if (bilinear(g, ray, s, b))
          for (int k = 0; k < 4; ++k) sum += b.weight[k] * volume[b.index[k]];
      image[static_cast<long>(r) * cols + c] = static_cast<T>(sum);
    });
  }
}

// Parallel over slabs of z: each thread walks all rays and keeps what falls into its own slices.
template <class T>
void project_volume_adjoint(const FrameIn& f, const GridIn& g, const T* image, int rows, int cols, T* volume,
                            int threads) {
  const int thick = (g.nz + 15) / 16;
  const long slice = static_cast<long>(g.nx) * g.ny;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int slab = 0; slab < (g.nz + thick - 1) / thick; ++slab) {
    const int z0 = slab * thick, z1 = z0 + thick < g.nz ? z0 + thick : g.nz;
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
      Bilinear b;
      for (int s = first; s <= last; ++s) {
        if (!bilinear(g, ray, s, b)) continue;
        for (int k = 0; k < 4; ++k)
          if (b.weight[k] != 0 && b.index[k] >= z0 * slice && b.index[k] < z1 * slice)
            volume[b.index[k]] += static_cast<T>(b.weight[k] * value);
      }
    });
  }
}

template <class T>
void backproject(const FrameIn& f, const GridIn& g, const T* image, int rows, int cols, double weight, T* volume,
                 int threads) {
  const View<T> view = make_view<T>(f, rows, cols);
  auto at = [](const Vec3<T>& k, double x, double y, double z) { return k.x * x + k.y * y + k.z * z; };
  const double iso = f.cone ? -at(view.k2, f.first[0], f.first[1], f.first[2]) : 1;
  const double* o = f.cone ? f.first : f.center;
  const T du = T(view.k0.x * g.voxel[2]), dv = T(view.k1.x * g.voxel[2]), dw = T(view.k2.x * g.voxel[2]);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int k = 0; k < g.nz; ++k) {
    for (int j = 0; j < g.ny; ++j) {
      const double x = g.center[0] - (g.nx - 1) / 2.0 * g.voxel[2] - o[0];
      const double y = g.center[1] + (j - (g.ny - 1) / 2.0) * g.voxel[1] - o[1];
      const double z = g.center[2] + (k - (g.nz - 1) / 2.0) * g.voxel[0] - o[2];
      const T u0 = T(at(view.k0, x, y, z)), v0 = T(at(view.k1, x, y, z)), w0 = T(at(view.k2, x, y, z));
      T* out = volume + (static_cast<long>(k) * g.ny + j) * g.nx;
      for (int i = 0; i < g.nx; ++i) {
        const T depth = f.cone ? w0 + T(i) * dw : T(1), inverse = T(1) / depth;
        const T c = (u0 + T(i) * du) * inverse + view.column0, r = (v0 + T(i) * dv) * inverse + view.row0;
        if (!(c >= T(0) && r >= T(0) && c <= T(cols - 1) && r <= T(rows - 1) && depth > T(0))) continue;
        const int ic = static_cast<int>(c) < cols - 1 ? static_cast<int>(c) : (cols > 1 ? cols - 2 : 0);
        const int ir = static_cast<int>(r) < rows - 1 ? static_cast<int>(r) : (rows > 1 ? rows - 2 : 0);
        const T fc = c - T(ic), fr = r - T(ir);
        const T* p = image + static_cast<long>(ir) * cols + ic;
        const int right = cols > 1 ? 1 : 0, down = rows > 1 ? cols : 0;
        const T top = p[0] + fc * (p[right] - p[0]), bottom = p[down] + fc * (p[down + right] - p[down]);
        const T ratio = T(iso) * inverse;
        out[i] += T(weight) * (f.cone ? ratio * ratio : T(1)) * (top + fr * (bottom - top));
      }
    }
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
