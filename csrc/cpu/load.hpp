// Between the caller's arrays of records and packs of Gaussians.
#pragma once

#include "api.hpp"
#include "math/view.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Splats first .. first + N - 1 as one pack; past the end the last one is repeated.
template <class P>
SPLAT_HD Gaussian<P> load_pack(const SplatsIn<typename P::Scalar>& s, int64_t first) {
  using T = typename P::Scalar;
  Gaussian<P> g;
  if (first + P::size <= s.count) {
    const T* mean = s.means + 3 * first;
    g.mean = {P::gather(mean, 3), P::gather(mean + 1, 3), P::gather(mean + 2, 3)};
    for (int k = 0; k < 3; ++k) g.scale[k] = P::gather(s.scales + 3 * first + k, 3);
    for (int k = 0; k < 4; ++k) g.quat[k] = P::gather(s.quats + 4 * first + k, 4);
    g.density = P::load(s.density + first);
    return g;
  }
  for (int i = 0; i < P::size; ++i) {
    const int64_t n = first + i < s.count ? first + i : s.count - 1;
    g.mean.x.v[i] = s.means[3 * n];
    g.mean.y.v[i] = s.means[3 * n + 1];
    g.mean.z.v[i] = s.means[3 * n + 2];
    for (int k = 0; k < 3; ++k) g.scale[k].v[i] = s.scales[3 * n + k];
    for (int k = 0; k < 4; ++k) g.quat[k].v[i] = s.quats[4 * n + k];
    g.density.v[i] = s.density[n];
  }
  return g;
}

template <class P>
SPLAT_HD void store_pack(const SplatsOut<typename P::Scalar>& out, int64_t first, int64_t count, const Vec3<P>& mean,
                         const P scale[3], const P quat[4], const P& density) {
  const int64_t n = count - first < P::size ? count - first : P::size;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t j = first + i;
    out.means[3 * j] = mean.x.v[i];
    out.means[3 * j + 1] = mean.y.v[i];
    out.means[3 * j + 2] = mean.z.v[i];
    for (int k = 0; k < 3; ++k) out.scales[3 * j + k] = scale[k].v[i];
    for (int k = 0; k < 4; ++k) out.quats[4 * j + k] = quat[k].v[i];
    out.density[j] = density.v[i];
  }
}

// A Gaussian that shows nowhere may have NaN for derivatives (it may lie in the source's plane): they become zero.
template <class P>
SPLAT_HD void clear_lane(GaussianGradient<P>& d, int lane) {
  P* all[] = {&d.mean.x, &d.mean.y, &d.mean.z, &d.torque.x, &d.torque.y, &d.torque.z, &d.density};
  for (P* p : all) p->v[lane] = 0;
  for (P& p : d.scale) p.v[lane] = 0;
  for (P& p : d.quat) p.v[lane] = 0;
}

}  // namespace SPLAT_NS
}  // namespace splat
