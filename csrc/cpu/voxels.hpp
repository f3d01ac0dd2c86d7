// Splats onto a voxel grid and back: the density at voxel centres, and its reverse.
//
// Forward is parallel over slabs of z slices, reverse over chunks of splats, as in cpu/renderer.hpp.
#pragma once

#include "cpu/buffer.hpp"
#include "cpu/load.hpp"
#include "kernels/stamp.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kSlab = 8;  // slices a slab

// A Gaussian on the grid: 2^(quadratic in voxel offsets), cut off like a stamp.
template <class T>
struct Blob {
  T i, j, k;                       // centre in voxel indices x, y, z
  T ii, jj, kk, ij, ik, jk;        // quadratic form in powers of two
  T density;
  int i0, i1, j0, j1, k0, k1;      // inclusive bounds; i0 > i1 where nothing shows
};

// Precision matrix A = R diag(1/s^2) R', six numbers xx yy zz xy xz yz.
template <class P>
struct Precision {
  P xx, yy, zz, xy, xz, yz;
};

template <class P>
SPLAT_HD Precision<P> precision_of(const Gaussian<P>& g, const Axes<P>& axes) {
  Precision<P> a{P(0), P(0), P(0), P(0), P(0), P(0)};
  for (int k = 0; k < 3; ++k) {
    const Vec3<P> c = (P(1) / g.scale[k]) * axes.column[k];
    a.xx += c.x * c.x, a.yy += c.y * c.y, a.zz += c.z * c.z;
    a.xy += c.x * c.y, a.xz += c.x * c.z, a.yz += c.y * c.z;
  }
  return a;
}

template <class T>
class VoxelGrid {
  using L = PackLanes<T>;
  using P = typename L::Value;

 public:
  explicit VoxelGrid(const GridIn& grid) : g_(grid) {}

  // Blobs of n <= P::size Gaussians.
  void blobs(const Gaussian<P>& g, int n, Blob<T>* out) const {
    const Axes<P> axes = axes_of(g.quat);
    const Precision<P> a = precision_of(g, axes);
    const T vx = T(g_.voxel[2]), vy = T(g_.voxel[1]), vz = T(g_.voxel[0]);
    for (int lane = 0; lane < n; ++lane) {
      Blob<T>& b = out[lane];
      b.i = (g.mean.x.v[lane] - T(g_.center[0])) / vx + T(g_.nx - 1) / 2;
      b.j = (g.mean.y.v[lane] - T(g_.center[1])) / vy + T(g_.ny - 1) / 2;
      b.k = (g.mean.z.v[lane] - T(g_.center[2])) / vz + T(g_.nz - 1) / 2;
      const T half = T(-0.5 * kLog2E);
      b.ii = half * a.xx.v[lane] * vx * vx, b.jj = half * a.yy.v[lane] * vy * vy, b.kk = half * a.zz.v[lane] * vz * vz;
      b.ij = 2 * half * a.xy.v[lane] * vx * vy, b.ik = 2 * half * a.xz.v[lane] * vx * vz;
      b.jk = 2 * half * a.yz.v[lane] * vy * vz;
      b.density = g.density.v[lane];
      // Half extents of the ellipsoid: reach * sqrt of the covariance's diagonal.
      T cx(0), cy(0), cz(0);
      for (int k = 0; k < 3; ++k) {
        const T s = g.scale[k].v[lane];
        const T x = s * axes.column[k].x.v[lane], y = s * axes.column[k].y.v[lane], z = s * axes.column[k].z.v[lane];
        cx += x * x, cy += y * y, cz += z * z;
      }
      const T reach = sqrt_of(T(kCutoff));
      bound(b.i, reach * sqrt_of(cx) / vx, g_.nx, b.i0, b.i1);
      bound(b.j, reach * sqrt_of(cy) / vy, g_.ny, b.j0, b.j1);
      bound(b.k, reach * sqrt_of(cz) / vz, g_.nz, b.k0, b.k1);
      if (b.j0 > b.j1 || b.k0 > b.k1 || b.density == T(0)) b.i1 = b.i0 - 1;
    }
  }

  // Calls visit(offset, i, dx, dy, dz, e) for every pack of voxels of the blob in slices [from, to).
  template <class Visit>
  void walk(const Blob<T>& b, int from, int to, Visit& visit) const {
    const P zero(T(0)), limit(T(-0.5 * kLog2E * kCutoff));
    const int k0 = b.k0 > from ? b.k0 : from, k1 = b.k1 < to - 1 ? b.k1 : to - 1;
    for (int k = k0; k <= k1; ++k) {
      const T dz = T(k) - b.k;
      for (int j = b.j0; j <= b.j1; ++j) {
        const T dy = T(j) - b.j;
        const T flat = dz * (b.kk * dz + b.jk * dy) + b.jj * dy * dy, lean = b.ij * dy + b.ik * dz;
        // The row's best value: flat - lean^2 / (4 ii); below the cutoff the row is skipped.
        if (flat - lean * lean / (4 * b.ii) < T(-0.5 * kLog2E * kCutoff)) continue;
        const long row = (static_cast<long>(k) * g_.ny + j) * g_.nx;
        for (int i = b.i0; i <= b.i1; i += P::size) {
          const P dx = L::index() + P(T(i) - b.i);
          const P power = P(flat) + dx * (P(lean) + P(b.ii) * dx);
          const P e = select(power > limit, exp2_of(power), zero);
          visit(row, i, dx, dy, dz, e);
        }
      }
    }
  }

  void voxelize(const SplatsIn<T>& splats, T* volume, int threads) {
    const int slabs = (g_.nz + kSlab - 1) / kSlab;
    Buffer<Blob<T>> all;
    Blob<T>* blobs_at = all.reserve(splats.count);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t first = 0; first < splats.count; first += P::size) {
      const int64_t n = splats.count - first < P::size ? splats.count - first : P::size;
      blobs(load_pack<P>(splats, first), static_cast<int>(n), blobs_at + first);
    }
    Buffer<int64_t> starts;
    Buffer<int32_t> orders;
    int64_t* start = starts.reserve(2 * slabs + 1);
    int64_t* next = start + slabs + 1;
    for (int s = 0; s <= slabs; ++s) start[s] = 0;
    for (int64_t n = 0; n < splats.count; ++n)
      if (blobs_at[n].i0 <= blobs_at[n].i1)
        for (int s = blobs_at[n].k0 / kSlab; s <= blobs_at[n].k1 / kSlab; ++s) ++start[s + 1];
    for (int s = 0; s < slabs; ++s) start[s + 1] += start[s];
    int32_t* order = orders.reserve(start[slabs]);
    for (int s = 0; s < slabs; ++s) next[s] = start[s];
    for (int64_t n = 0; n < splats.count; ++n)
      if (blobs_at[n].i0 <= blobs_at[n].i1)
        for (int s = blobs_at[n].k0 / kSlab; s <= blobs_at[n].k1 / kSlab; ++s) order[next[s]++] = static_cast<int32_t>(n);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int s = 0; s < slabs; ++s) {
      const int from = s * kSlab, to = from + kSlab < g_.nz ? from + kSlab : g_.nz;
      const long slice = static_cast<long>(g_.ny) * g_.nx;
      memset(volume + from * slice, 0, static_cast<size_t>(to - from) * slice * sizeof(T));
      for (int64_t n = start[s]; n < start[s + 1]; ++n) {
        const Blob<T>& b = blobs_at[order[n]];
        auto add = [&](long row, int i, P, T, T, P e) {
          const P value = P(b.density) * e;
          if (i + P::size <= g_.nx) {
            (P::load(volume + row + i) + value).store(volume + row + i);
          } else {
            for (int lane = 0; i + lane < g_.nx; ++lane) volume[row + i + lane] += value.v[lane];
          }
        };
        walk(b, from, to, add);
      }
    }
  }

  void voxelize_vjp(const SplatsIn<T>& splats, const T* v_volume, const SplatsOut<T>& v, int threads) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 64)
    for (int64_t first = 0; first < splats.count; first += P::size) {
      const int n = splats.count - first < P::size ? static_cast<int>(splats.count - first) : P::size;
      const Gaussian<P> g = load_pack<P>(splats, first);
      Blob<T> blob[P::size];
      blobs(g, n, blob);
      P sums[10];  // G e times 1, dx, dy, dz, dx^2, dy^2, dz^2, dx dy, dx dz, dy dz, in mm
      for (P& s : sums) s = P(T(0));
      for (int lane = 0; lane < n; ++lane) {
        P one(T(0)), x(T(0)), y(T(0)), z(T(0)), xx(T(0)), yy(T(0)), zz(T(0)), xy(T(0)), xz(T(0)), yz(T(0));
        auto gather = [&](long row, int i, P dx, T dy, T dz, P e) {
          P grad;
          if (i + P::size <= g_.nx) {
            grad = P::load(v_volume + row + i);
          } else {
            for (int k = 0; k < P::size; ++k) grad.v[k] = i + k < g_.nx ? v_volume[row + i + k] : T(0);
          }
          const P t = grad * e, tx = t * dx, ty = t * P(dy), tz = t * P(dz);
          one += t, x += tx, y += ty, z += tz;
          xx += tx * dx, yy += ty * P(dy), zz += tz * P(dz), xy += tx * P(dy), xz += tx * P(dz), yz += ty * P(dz);
        };
        walk(blob[lane], 0, g_.nz, gather);
        const T vx = T(g_.voxel[2]), vy = T(g_.voxel[1]), vz = T(g_.voxel[0]);
        const P* from[10] = {&one, &x, &y, &z, &xx, &yy, &zz, &xy, &xz, &yz};
        const T unit[10] = {1, vx, vy, vz, vx * vx, vy * vy, vz * vz, vx * vy, vx * vz, vy * vz};
        for (int k = 0; k < 10; ++k) sums[k].v[lane] = unit[k] * L::sum(*from[k]);
      }
      // value = density exp(-d'Ad/2): dL/dmean = density A m1, dL/dA = -density M2 / 2, and with
      // A = sum_k c_k c_k', c_k = column_k / s_k: dL/dc_k = -density M2 c_k.
      const Axes<P> axes = axes_of(g.quat);
      const Precision<P> a = precision_of(g, axes);
      const P d = g.density;
      const Vec3<P> mean{d * (a.xx * sums[1] + a.xy * sums[2] + a.xz * sums[3]),
                         d * (a.xy * sums[1] + a.yy * sums[2] + a.yz * sums[3]),
                         d * (a.xz * sums[1] + a.yz * sums[2] + a.zz * sums[3])};
      P scale[3], quat[4];
      Axes<P> v_axes;
      for (int k = 0; k < 3; ++k) {
        const P inverse = P(T(1)) / g.scale[k];
        const Vec3<P> c = inverse * axes.column[k];
        const Vec3<P> v_c{-d * (sums[4] * c.x + sums[7] * c.y + sums[8] * c.z),
                          -d * (sums[7] * c.x + sums[5] * c.y + sums[9] * c.z),
                          -d * (sums[8] * c.x + sums[9] * c.y + sums[6] * c.z)};
        v_axes.column[k] = inverse * v_c;
        scale[k] = -inverse * dot(c, v_c);
      }
      axes_of_vjp(g.quat, axes, v_axes, quat);
      store_pack<P>(v, first, splats.count, mean, scale, quat, sums[0]);
    }
  }

 private:
  static void bound(T center, T reach, int n, int& low, int& high) {
    const T left = max_of(center - reach, T(0)), right = min_of(center + reach, T(n - 1));
    low = 0;
    high = -1;
    if (!(left <= right)) return;
    low = static_cast<int>(ceil(left));
    high = static_cast<int>(floor(right));
  }

  const GridIn g_;
};

}  // namespace SPLAT_NS
}  // namespace splat
