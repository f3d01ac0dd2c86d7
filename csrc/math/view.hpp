// A view as the kernels take it, from a frame.
#pragma once

#include "api.hpp"
#include "math/camera.hpp"

namespace splat {
inline namespace SPLAT_NS {

// K = [u | v | center - source]^-1 (cone) or [u | v | ray]^-1 (parallel), in double. Host only.
template <class T>
inline View<T> make_view(const FrameIn& f, int rows, int cols) {
  double third[3], length = 1;
  for (int i = 0; i < 3; ++i) third[i] = f.cone ? f.center[i] - f.first[i] : f.first[i];
  if (!f.cone) length = sqrt(third[0] * third[0] + third[1] * third[1] + third[2] * third[2]);
  const Vec3<double> u{f.u[0], f.u[1], f.u[2]}, v{f.v[0], f.v[1], f.v[2]}, w{third[0], third[1], third[2]};
  const double det = dot(cross(u, v), w), inverse = 1 / det;
  const double* o = f.cone ? f.first : f.center;
  auto to = [](const Vec3<double>& a) { return Vec3<T>{T(a.x), T(a.y), T(a.z)}; };
  View<T> view;
  view.k0 = to(inverse * cross(v, w));
  view.k1 = to(inverse * cross(w, u));
  view.k2 = to(inverse * cross(u, v));
  view.origin = to({o[0], o[1], o[2]});
  view.column0 = T((cols - 1) / 2.0);
  view.row0 = T((rows - 1) / 2.0);
  view.det_k = T(fabs(inverse) * length);
  view.cone = f.cone;
  return view;
}

// The same view for another number type, every lane of a pack alike.
template <class P, class T>
inline View<P> widen(const View<T>& v) {
  auto to = [](const Vec3<T>& a) { return Vec3<P>{P(a.x), P(a.y), P(a.z)}; };
  return {to(v.k0), to(v.k1), to(v.k2), to(v.origin), P(v.column0), P(v.row0), P(v.det_k), v.cone};
}

}  // namespace SPLAT_NS
}  // namespace splat
