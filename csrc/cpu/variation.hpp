// Anisotropic total variation of a box of voxels: the mean |difference| of neighbours along the three axes.
#pragma once

#include "cpu/buffer.hpp"
#include "kernels/lanes.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Row v against another of n voxels: adds the sign of v - w to slope, returns the sum of |v - w|.
template <class T>
inline double against(const T* v, const T* w, int n, T* slope) {
  using P = typename PackLanes<T>::Value;
  const P zero(T(0)), one(T(1));
  P packs(T(0));
  int x = 0;
  for (; x + P::size <= n; x += P::size) {
    const P d = P::load(v + x) - P::load(w + x);
    (P::load(slope + x) + select(d > zero, one, zero) - select(d < zero, one, zero)).store(slope + x);
    packs += max_of(d, -d);
  }
  T sum = PackLanes<T>::sum(packs);
  for (; x < n; ++x) {
    const T d = v[x] - w[x];
    slope[x] += static_cast<T>((d > 0) - (d < 0));  // without a branch that noise would mispredict
    sum += fabs(d);
  }
  return sum;
}

// Returns the variation, overwrites gradient; where two neighbours are equal the slope is taken as zero.
template <class T>
double total_variation(int nz, int ny, int nx, const T* volume, T* gradient, int threads) {
  const int64_t plane = static_cast<int64_t>(ny) * nx;
  const int64_t pairs = (nz - 1) * plane + nz * (plane - nx) + nz * (plane - ny);
  const T each = static_cast<T>(pairs > 0 ? pairs : 1);
  Buffer<double> partial;
  double* sums = partial.reserve(nz);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int z = 0; z < nz; ++z) {
    double sum = 0;  // of both sides of every pair
    for (int y = 0; y < ny; ++y) {
      const T* v = volume + z * plane + static_cast<int64_t>(y) * nx;
      T* slope = gradient + (v - volume);
      for (int x = 0; x < nx; ++x) slope[x] = 0;
      sum += against(v, v + 1, nx - 1, slope) + against(v + 1, v, nx - 1, slope + 1);
      if (y > 0) sum += against(v, v - nx, nx, slope);
      if (y + 1 < ny) sum += against(v, v + nx, nx, slope);
      if (z > 0) sum += against(v, v - plane, nx, slope);
      if (z + 1 < nz) sum += against(v, v + plane, nx, slope);
      for (int x = 0; x < nx; ++x) slope[x] /= each;
    }
    sums[z] = sum;
  }
  double total = 0;
  for (int z = 0; z < nz; ++z) total += sums[z];
  return total / 2 / each;
}

}  // namespace SPLAT_NS
}  // namespace splat
