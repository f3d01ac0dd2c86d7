// Between the caller's arrays of records and packs of Gaussians or views.
#pragma once

#include "api.hpp"
#include "math/camera.hpp"

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

// K = [u | v | center - source]^-1 (cone) or [u | v | ray]^-1 (parallel), in double.
template <class S>
inline View<S> make_view(const FrameIn& f, int rows, int cols) {
  double third[3], length = 1;
  for (int i = 0; i < 3; ++i) third[i] = f.cone ? f.center[i] - f.first[i] : f.first[i];
  if (!f.cone) length = sqrt(third[0] * third[0] + third[1] * third[1] + third[2] * third[2]);
  const Vec3<double> u{f.u[0], f.u[1], f.u[2]}, v{f.v[0], f.v[1], f.v[2]}, w{third[0], third[1], third[2]};
  const double det = dot(cross(u, v), w), inverse = 1 / det;
  const Vec3<double> k0 = inverse * cross(v, w), k1 = inverse * cross(w, u), k2 = inverse * cross(u, v);
  const double* o = f.cone ? f.first : f.center;
  auto to = [](const Vec3<double>& a) {
    using T = typename S::Scalar;
    return Vec3<S>{S(T(a.x)), S(T(a.y)), S(T(a.z))};
  };
  using T = typename S::Scalar;
  View<S> view;
  view.k0 = to(k0);
  view.k1 = to(k1);
  view.k2 = to(k2);
  view.origin = to({o[0], o[1], o[2]});
  view.column0 = S(T((cols - 1) / 2.0));
  view.row0 = S(T((rows - 1) / 2.0));
  view.det_k = S(T(fabs(inverse) * length));
  view.cone = f.cone;
  return view;
}

}  // namespace SPLAT_NS
}  // namespace splat
