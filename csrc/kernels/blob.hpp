// Blob: a Gaussian among voxels made ready to be walked, the walk, and its reverse; as stamp.hpp for pixels.
#pragma once

#include "api.hpp"
#include "kernels/stamp.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Precision matrix A = R diag(1/s^2) R', six numbers.
template <class T>
struct Precision {
  T xx, yy, zz, xy, xz, yz;
};

template <class T>
SPLAT_HD Precision<T> precision_of(const Gaussian<T>& g, const Axes<T>& axes) {
  Precision<T> a{T(0), T(0), T(0), T(0), T(0), T(0)};
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> c = (T(1) / g.scale[k]) * axes.column[k];
    a.xx += c.x * c.x, a.yy += c.y * c.y, a.zz += c.z * c.z;
    a.xy += c.x * c.y, a.xz += c.x * c.z, a.yz += c.y * c.z;
  }
  return a;
}

// In voxel indices: the centre, the exponent in powers of two, the half extents of the ellipsoid.
template <class T>
struct BlobShape {
  T i, j, k;                 // x, y, z
  T ii, jj, kk, ij, ik, jk;  // 2^(ii di^2 + .. + jk dj dk)
  T reach_i, reach_j, reach_k;
};

template <class T>
SPLAT_HD BlobShape<T> blob_shape(const GridIn& grid, const Gaussian<T>& g) {
  const Axes<T> axes = axes_of(g.quat);
  const Precision<T> a = precision_of(g, axes);
  const T vx(grid.voxel[2]), vy(grid.voxel[1]), vz(grid.voxel[0]), half(-0.5 * kLog2E), whole(-kLog2E);
  BlobShape<T> b;
  b.i = (g.mean.x - T(grid.center[0])) / vx + T((grid.nx - 1) / 2.0);
  b.j = (g.mean.y - T(grid.center[1])) / vy + T((grid.ny - 1) / 2.0);
  b.k = (g.mean.z - T(grid.center[2])) / vz + T((grid.nz - 1) / 2.0);
  b.ii = half * a.xx * vx * vx, b.jj = half * a.yy * vy * vy, b.kk = half * a.zz * vz * vz;
  b.ij = whole * a.xy * vx * vy, b.ik = whole * a.xz * vx * vz, b.jk = whole * a.yz * vy * vz;
  // The ellipsoid's half extents: sqrt(cutoff) times the roots of the covariance's diagonal.
  T x(0), y(0), z(0);
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> h = g.scale[k] * axes.column[k];
    x += h.x * h.x, y += h.y * h.y, z += h.z * h.z;
  }
  const T cutoff(kCutoff);
  b.reach_i = sqrt_of(cutoff * x) / vx;
  b.reach_j = sqrt_of(cutoff * y) / vy;
  b.reach_k = sqrt_of(cutoff * z) / vz;
  return b;
}

template <class T>
struct Blob {
  BlobShape<T> shape;
  T density;
  T bend;                      // 2^(2 jj): the second ratio of values one row apart
  int run;                     // rows from one exponential to the next, 1 .. kRun
  int i0, i1, j0, j1, k0, k1;  // inclusive bounds inside the volume; i0 > i1 where nothing shows
};

template <class T>
SPLAT_HD void bound(T center, T reach, int n, int& low, int& high) {
  const T left = max_of(center - reach, T(0)), right = min_of(center + reach, T(n - 1));
  low = 0;
  high = -1;
  if (!(left <= right)) return;
  low = static_cast<int>(ceil(left));
  high = static_cast<int>(floor(right));
}

// L: the lanes that will walk it. A Gaussian outside the volume, without mass or not finite gives an empty blob.
template <class L, class T>
SPLAT_HD Blob<T> make_blob(const GridIn& grid, const BlobShape<T>& s, T density) {
  Blob<T> b;
  b.shape = s;
  b.density = density;
  bound(s.i, s.reach_i, grid.nx, b.i0, b.i1);
  bound(s.j, s.reach_j, grid.ny, b.j0, b.j1);
  bound(s.k, s.reach_k, grid.nz, b.k0, b.k1);
  const bool finite = s.ii < T(0) && s.jj < T(0) && s.kk < T(0) && density != T(0) &&
                      (density + s.ii + s.jj + s.kk + s.i + s.j + s.k) * T(0) == T(0);
  if (b.j0 > b.j1 || b.k0 > b.k1 || !finite) b.i1 = b.i0 - 1;
  // As for stamps: how far the exponent may rise from one row to the next.
  const T growth = max_of(s.ij, -s.ij) * (s.reach_i + T(L::count)) + max_of(s.jk, -s.jk) * (s.reach_k + T(1)) -
                   T(2) * s.jj * (s.reach_j + T(1));
  b.run = static_cast<int>(min_of(T(1) + T(-kFloor - 12) / growth, T(kRun)));
  b.bend = exp2_of(max_of(T(2) * s.jj, T(kFloor)));
  return b;
}

// Calls visit(row, i, dy, e) for every `count` voxels (row + i + lane) of the blob in slices [from, to): e is the
// unit-density value, zero beyond the cutoff; dx, dy, dz count voxels from the centre. Each slice of a blob is a
// footprint, walked down its rows as stamps are: by products, visit.enter() before the rows of a group of columns and
// visit.leave(dx, dz) after them.
template <class L, class T, class Visit>
SPLAT_HD void walk_blob(const GridIn& grid, const Blob<T>& b, int from, int to, Visit& visit) {
  using V = typename L::Value;
  const T limit(-0.5 * kLog2E * kCutoff);
  const V zero(T(0)), cutoff{T(kCutoffValue)}, lowest{T(kFloor)}, bend(b.bend);
  const BlobShape<T>& s = b.shape;
  const int k0 = b.k0 > from ? b.k0 : from, k1 = b.k1 < to - 1 ? b.k1 : to - 1;
  // The best exponent of a row, over dx, is kk dz^2 + jk dz dy + jj dy^2 with these.
  const T per = T(1) / (T(4) * s.ii), jj = s.jj - s.ij * s.ij * per, kk = s.kk - s.ik * s.ik * per;
  const T jk = s.jk - T(2) * s.ij * s.ik * per;
  for (int k = k0; k <= k1; ++k) {
    const T dz = T(k) - s.k;
    int j0 = b.j0, j1 = b.j1;
    if (j1 - j0 >= 2 * kRun) {  // many rows: those of this slice; else the branches cost more
      const T middle = -jk * dz / (T(2) * jj);
      const T room = (limit - (kk * dz + T(0.5) * jk * middle) * dz) / jj;  // half the slice's height, squared
      if (!(room >= T(0))) continue;
      bound(s.j + middle, sqrt_of(room), grid.ny, j0, j1);
    }
    for (int i = b.i0; i <= b.i1; i += L::count) {
      const V dx = L::index() + V(T(i) - s.i);
      const V along = V(s.kk * dz * dz) + dx * (V(s.ik * dz) + V(s.ii) * dx), mixed = V(s.ij) * dx + V(s.jk * dz);
      visit.enter();
      for (int j = j0; j <= j1;) {
        const T dy = T(j) - s.j;
        V value = exp2_of(max_of(along + V(dy) * (mixed + V(s.jj * dy)), lowest));
        V ratio = exp2_of(max_of(mixed + V(s.jj * (dy + dy + T(1))), lowest));
        const int stop = j1 < j + b.run - 1 ? j1 : j + b.run - 1;
        for (;;) {
          const long row = (static_cast<long>(k) * grid.ny + j) * grid.nx;
          visit(row, i, T(j) - s.j, select(value > cutoff, value, zero));
          if (++j > stop) break;
          value *= ratio;
          ratio *= bend;
        }
      }
      visit.leave(dx, dz);
    }
  }
}

// Sums of G e times 1, dx, dy, dz, and the six products of two of them, over a blob; G = dL/dvolume.
template <class T>
struct BlobMoments {
  T one, x, y, z, xx, yy, zz, xy, xz, yz;
};

template <class L, class T, class Read>
struct GatherBlob {
  using V = typename L::Value;
  Read read;  // read(row, i): the gradient at voxels row + i + lane, zero beyond the end of the row
  BlobMoments<V> m{V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0)), V(T(0))};
  V g0{T(0)}, g1{T(0)}, g2{T(0)};  // of the present columns: sums of G e times 1, dy, dy^2
  SPLAT_HD void enter() { g0 = g1 = g2 = V(T(0)); }
  SPLAT_HD void operator()(long row, int i, T dy, V e) {
    const V g = read(row, i) * e, gy = g * V(dy);
    g0 += g;
    g1 += gy;
    g2 += gy * V(dy);
  }
  SPLAT_HD void leave(V dx, T dz) {
    const V gx = g0 * dx, gz = g0 * V(dz);
    m.one += g0, m.x += gx, m.y += g1, m.z += gz;
    m.xx += gx * dx, m.yy += g2, m.zz += gz * V(dz), m.xy += g1 * dx, m.xz += gz * dx, m.yz += g1 * V(dz);
  }
  // In mm.
  SPLAT_HD BlobMoments<T> total(const GridIn& grid) const {
    const T x(grid.voxel[2]), y(grid.voxel[1]), z(grid.voxel[0]);
    return {L::sum(m.one),        x * L::sum(m.x),      y * L::sum(m.y),      z * L::sum(m.z),
            x * x * L::sum(m.xx), y * y * L::sum(m.yy), z * z * L::sum(m.zz),
            x * y * L::sum(m.xy), x * z * L::sum(m.xz), y * z * L::sum(m.yz)};
  }
};

// From the moments to dL/d(Gaussian); `torque` is left at zero. value = density exp(-d'Ad/2): dL/dmean = density A m1,
// dL/dA = -density M2 / 2, and with A = sum_k c_k c_k', c_k = column_k / s_k: dL/dc_k = -density M2 c_k.
template <class T>
SPLAT_HD GaussianGradient<T> blob_vjp(const Gaussian<T>& g, const BlobMoments<T>& m) {
  const Axes<T> axes = axes_of(g.quat);
  const Precision<T> a = precision_of(g, axes);
  GaussianGradient<T> v;
  v.torque = {T(0), T(0), T(0)};
  v.density = m.one;
  v.mean = g.density * Vec3<T>{a.xx * m.x + a.xy * m.y + a.xz * m.z, a.xy * m.x + a.yy * m.y + a.yz * m.z,
                               a.xz * m.x + a.yz * m.y + a.zz * m.z};
  Axes<T> v_axes;
  for (int k = 0; k < 3; ++k) {
    const T inverse = T(1) / g.scale[k];
    const Vec3<T> c = inverse * axes.column[k];
    const Vec3<T> v_c = -g.density * Vec3<T>{m.xx * c.x + m.xy * c.y + m.xz * c.z, m.xy * c.x + m.yy * c.y + m.yz * c.z,
                                             m.xz * c.x + m.yz * c.y + m.zz * c.z};
    v_axes.column[k] = inverse * v_c;
    v.scale[k] = -inverse * dot(c, v_c);
  }
  axes_of_vjp(g.quat, axes, v_axes, v.quat);
  return v;
}

}  // namespace SPLAT_NS
}  // namespace splat
