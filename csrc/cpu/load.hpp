// Between the caller's arrays of records and packs of Gaussians.
#pragma once

#include "api.hpp"
#include "math/view.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class P, class T>
SPLAT_HD Gaussian<P> from_arrays(const T* means, const T* scales, const T* quats, const T* density) {
  P mean[3], scale[3], quat[4];
  from_records(means, mean);
  from_records(scales, scale);
  from_records(quats, quat);
  return {{mean[0], mean[1], mean[2]},
          {scale[0], scale[1], scale[2]},
          {quat[0], quat[1], quat[2], quat[3]},
          P::load(density)};
}

// Splats index(0) .. index(N - 1) as one pack.
template <class P, class Index>
SPLAT_HD Gaussian<P> load_each(const SplatsIn<typename P::Scalar>& s, Index index) {
  using T = typename P::Scalar;
  T means[3 * P::size], scales[3 * P::size], quats[4 * P::size], density[P::size];
  for (int i = 0; i < P::size; ++i) {
    const int64_t n = index(i);
    for (int k = 0; k < 3; ++k) means[3 * i + k] = s.means[3 * n + k];
    for (int k = 0; k < 3; ++k) scales[3 * i + k] = s.scales[3 * n + k];
    for (int k = 0; k < 4; ++k) quats[4 * i + k] = s.quats[4 * n + k];
    density[i] = s.density[n];
  }
  return from_arrays<P>(means, scales, quats, density);
}

// Splats first .. first + N - 1; past the end the last one is repeated.
template <class P>
SPLAT_HD Gaussian<P> load_pack(const SplatsIn<typename P::Scalar>& s, int64_t first) {
  if (first + P::size <= s.count)
    return from_arrays<P>(s.means + 3 * first, s.scales + 3 * first, s.quats + 4 * first, s.density + first);
  return load_each<P>(s, [&](int i) { return first + i < s.count ? first + i : s.count - 1; });
}

// `n` records of K numbers, n <= N.
template <class T, int N, int K>
SPLAT_HD void store_records(const Pack<T, N> (&in)[K], T* records, int n) {
  if (n == N) return to_records(in, records);
  T all[K * N];
  to_records(in, all);
  for (int i = 0; i < K * n; ++i) records[i] = all[i];
}

// Writes the gradients of splats first .. first + n - 1. Those that are not `shown` may have NaN for derivatives (they
// may lie in the source's plane): theirs become zero.
template <class P>
SPLAT_HD void store_pack(const SplatsOut<typename P::Scalar>& out, int64_t first, int n,
                         const GaussianGradient<P>& d, typename P::Mask shown) {
  const P zero(typename P::Scalar(0));
  auto keep = [&](P v) { return select(shown, v, zero); };
  const P mean[3] = {keep(d.mean.x), keep(d.mean.y), keep(d.mean.z)};
  const P scale[3] = {keep(d.scale[0]), keep(d.scale[1]), keep(d.scale[2])};
  const P quat[4] = {keep(d.quat[0]), keep(d.quat[1]), keep(d.quat[2]), keep(d.quat[3])};
  const P density[1] = {keep(d.density)};
  store_records(mean, out.means + 3 * first, n);
  store_records(scale, out.scales + 3 * first, n);
  store_records(quat, out.quats + 4 * first, n);
  store_records(density, out.density + first, n);
}

}  // namespace SPLAT_NS
}  // namespace splat
