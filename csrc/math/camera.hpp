// Projection of a Gaussian through one view, its reverse, and its derivative along the view's motion.
//
// A view sends a point x to q = K (x - origin). Cone beam: (column, row) = (q0, q1) / q2, and q2 is the
// share of the way from source to detector; parallel beam: (column, row) = (q0, q1). Ray space is
// (column, row, length along the ray), as in the paper's eq. 2, whose third row makes the projected
// amplitude right (eq. 4, 5): with T the 2x3 image of the Gaussian's half axes, S = T T',
//     integral at the centre = density sqrt(2 pi) |det J| s0 s1 s2 / sqrt(det S),
// and det J = |x - origin| det K / q2^3 in closed form (parallel: |ray| det K). det S is computed as
// |t0 x t1|^2 (Lagrange), which has no cancellation for needles in single precision.
#pragma once

#include "math/gaussian.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
struct View {
  Vec3<T> k0, k1, k2;  // rows of K
  Vec3<T> origin;      // source (cone) or detector centre (parallel), mm
  T column0, row0;     // the pixel of the detector's centre
  T det_k;             // |det K|; for parallel beams times |ray|
  bool cone;
};

// What a Gaussian leaves on the detector: amplitude * exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2).
template <class T>
struct Footprint {
  T column, row;     // centre, px
  T a, b, c;         // inverse of the covariance, 1/px^2
  T amplitude;       // line integral at the centre, unitless
};

// Intermediates that the derivatives need again.
template <class T>
struct Projected {
  Vec3<T> offset;        // x - origin, mm
  Vec3<T> half_axis[3];  // s_k times the k-th axis: the columns of M
  Axes<T> axes;
  Vec3<T> j0, j1;        // gradients of column and row, px/mm
  T column_rel, row_rel; // before the detector's centre is added
  T inverse_depth;       // 1/q2
  T t0[3], t1[3];        // T = J2 M
  T cov_cc, cov_cr, cov_rr;  // S
  T per_density;         // amplitude / density
  Footprint<T> foot;
};

template <class T>
SPLAT_HD Projected<T> project(const View<T>& view, const Gaussian<T>& g) {
  Projected<T> p;
  p.offset = g.mean - view.origin;
  const T q0 = dot(view.k0, p.offset), q1 = dot(view.k1, p.offset);
  T det_j = view.det_k;
  if (view.cone) {
    p.inverse_depth = T(1) / dot(view.k2, p.offset);
    p.column_rel = q0 * p.inverse_depth;
    p.row_rel = q1 * p.inverse_depth;
    p.j0 = p.inverse_depth * (view.k0 - p.column_rel * view.k2);
    p.j1 = p.inverse_depth * (view.k1 - p.row_rel * view.k2);
    det_j = det_j * sqrt_of(dot(p.offset, p.offset)) * p.inverse_depth * p.inverse_depth * p.inverse_depth;
  } else {
    p.inverse_depth = T(1);
    p.column_rel = q0;
    p.row_rel = q1;
    p.j0 = view.k0;
    p.j1 = view.k1;
  }
  p.axes = axes_of(g.quat);
  for (int k = 0; k < 3; ++k) {
    p.half_axis[k] = g.scale[k] * p.axes.column[k];
    p.t0[k] = dot(p.j0, p.half_axis[k]);
    p.t1[k] = dot(p.j1, p.half_axis[k]);
  }
  const Vec3<T> t0{p.t0[0], p.t0[1], p.t0[2]}, t1{p.t1[0], p.t1[1], p.t1[2]};
  const Vec3<T> normal = cross(t0, t1);
  const T det = dot(normal, normal), inverse_det = T(1) / det;
  p.cov_cc = dot(t0, t0);
  p.cov_cr = dot(t0, t1);
  p.cov_rr = dot(t1, t1);
  p.foot.column = p.column_rel + view.column0;
  p.foot.row = p.row_rel + view.row0;
  p.foot.a = p.cov_rr * inverse_det;
  p.foot.b = -p.cov_cr * inverse_det;
  p.foot.c = p.cov_cc * inverse_det;
  const T sqrt_two_pi(2.5066282746310002);
  p.per_density = sqrt_two_pi * det_j * g.scale[0] * g.scale[1] * g.scale[2] * sqrt_of(inverse_det);
  p.foot.amplitude = g.density * p.per_density;
  return p;
}

// The six sums over the pixels of one footprint that any loss gradient G(pixel) = dL/dI reaches the
// Gaussian by: sum of G e, G e dx, G e dy, G e dx^2, G e dx dy, G e dy^2 with e the unit-amplitude value.
template <class T>
struct Moments {
  T one, x, y, xx, xy, yy;
};

// dL/d(Gaussian) and dL/d(rigid motion x -> x + omega x x + tau of the object, in the world).
template <class T>
struct GaussianGradient {
  Vec3<T> mean;
  T scale[3];
  T quat[4];
  T density;
  Vec3<T> torque;  // dL/domega of this Gaussian; dL/dtau is `mean`
};

template <class T>
SPLAT_HD GaussianGradient<T> project_vjp(const View<T>& view, const Gaussian<T>& g, const Projected<T>& p,
                                         const Moments<T>& m) {
  GaussianGradient<T> v;
  const Footprint<T>& f = p.foot;
  const T amplitude = f.amplitude;
  const T v_column = amplitude * (f.a * m.x + f.b * m.y);
  const T v_row = amplitude * (f.b * m.x + f.c * m.y);
  v.density = m.one * p.per_density;
  // dL/dS = amplitude (Q M2 Q - one Q) / 2: the shape of the footprint, and the amplitude's 1/sqrt(det S).
  const T half(0.5);
  const T n00 = m.xx * f.a + m.xy * f.b, n01 = m.xx * f.b + m.xy * f.c;
  const T n10 = m.xy * f.a + m.yy * f.b, n11 = m.xy * f.b + m.yy * f.c;
  const T s00 = half * amplitude * (f.a * n00 + f.b * n10 - m.one * f.a);
  const T s01 = half * amplitude * (f.a * n01 + f.b * n11 - m.one * f.b);
  const T s11 = half * amplitude * (f.b * n01 + f.c * n11 - m.one * f.c);
  const T two(2), along = m.one * amplitude;  // along = amplitude dL/damplitude = dL/d(ln amplitude)
  Vec3<T> v_j0{T(0), T(0), T(0)}, v_j1{T(0), T(0), T(0)};
  Axes<T> v_axes;
  v.torque = {T(0), T(0), T(0)};
  for (int k = 0; k < 3; ++k) {
    const T v_t0 = two * (s00 * p.t0[k] + s01 * p.t1[k]);
    const T v_t1 = two * (s01 * p.t0[k] + s11 * p.t1[k]);
    v_j0 = v_j0 + v_t0 * p.half_axis[k];
    v_j1 = v_j1 + v_t1 * p.half_axis[k];
    const Vec3<T> v_half = v_t0 * p.j0 + v_t1 * p.j1;
    v.scale[k] = dot(v_half, p.axes.column[k]) + along / g.scale[k];
    v_axes.column[k] = g.scale[k] * v_half;
    v.torque = v.torque + cross(p.half_axis[k], v_half);
  }
  axes_of_vjp(g.quat, p.axes, v_axes, v.quat);
  T to_column = v_column, to_row = v_row;
  Vec3<T> v_mean{T(0), T(0), T(0)};
  if (view.cone) {
    to_column = to_column - p.inverse_depth * dot(v_j0, view.k2);
    to_row = to_row - p.inverse_depth * dot(v_j1, view.k2);
    const T v_depth = -p.inverse_depth * (dot(v_j0, p.j0) + dot(v_j1, p.j1) + T(3) * along);
    v_mean = v_depth * view.k2 + (along / dot(p.offset, p.offset)) * p.offset;
  }
  v.mean = v_mean + to_column * p.j0 + to_row * p.j1;
  v.torque = v.torque + cross(g.mean, v.mean);
  return v;
}

// The directions in which the normal equations of a view are taken.
inline constexpr int kRigid = 6;      // 0..2 omega (rotation vector, rad), 3..5 tau (mm) of x -> x + omega x x + tau
inline constexpr int kDirections = 12;  // 6..11 strain xx, yy, zz, yz, xz, xy of the means, x -> x + E x

template <class T>
SPLAT_HD Vec3<T> mean_velocity(const Vec3<T>& mean, int direction) {
  const T zero(0), one(1);
  const int axis = direction % 3;
  const Vec3<T> unit{axis == 0 ? one : zero, axis == 1 ? one : zero, axis == 2 ? one : zero};
  if (direction < 3) return cross(unit, mean);
  if (direction < 6) return unit;
  if (direction < 9) return {unit.x * mean.x, unit.y * mean.y, unit.z * mean.z};
  return {unit.z * mean.y + unit.y * mean.z, unit.z * mean.x + unit.x * mean.z, unit.y * mean.x + unit.x * mean.y};
}

// d(footprint value)/d(direction) = value * (one + x dx + y dy + xx dx^2 + xy dx dy + yy dy^2).
template <class T>
SPLAT_HD Moments<T> motion_derivative(const View<T>& view, const Gaussian<T>& g, const Projected<T>& p, int direction) {
  const T zero(0), one(1);
  const Vec3<T> unit{direction == 0 ? one : zero, direction == 1 ? one : zero, direction == 2 ? one : zero};
  const bool turn = direction < 3;
  const Vec3<T> d_mean = mean_velocity(g.mean, direction);
  const T d_column = dot(p.j0, d_mean), d_row = dot(p.j1, d_mean);
  Vec3<T> d_j0{zero, zero, zero}, d_j1{zero, zero, zero};
  T d_log(0);  // of det J
  if (view.cone) {
    const T d_depth = dot(view.k2, d_mean) * p.inverse_depth;  // relative
    d_j0 = -d_depth * p.j0 - (d_column * p.inverse_depth) * view.k2;
    d_j1 = -d_depth * p.j1 - (d_row * p.inverse_depth) * view.k2;
    d_log = dot(p.offset, d_mean) / dot(p.offset, p.offset) - T(3) * d_depth;
  }
  T d_cc(0), d_cr(0), d_rr(0);
  for (int k = 0; k < 3; ++k) {
    T d_t0 = dot(d_j0, p.half_axis[k]), d_t1 = dot(d_j1, p.half_axis[k]);
    if (turn) {
      const Vec3<T> d_half = cross(unit, p.half_axis[k]);
      d_t0 += dot(p.j0, d_half);
      d_t1 += dot(p.j1, d_half);
    }
    d_cc += T(2) * p.t0[k] * d_t0;
    d_rr += T(2) * p.t1[k] * d_t1;
    d_cr += p.t0[k] * d_t1 + p.t1[k] * d_t0;
  }
  // dQ = -Q dS Q, and d ln amplitude = d ln det J - tr(Q dS) / 2
  const Footprint<T>& f = p.foot;
  const T n00 = d_cc * f.a + d_cr * f.b, n01 = d_cc * f.b + d_cr * f.c;
  const T n10 = d_cr * f.a + d_rr * f.b, n11 = d_cr * f.b + d_rr * f.c;
  const T half(0.5);
  Moments<T> d;
  d.one = d_log - half * (n00 + n11);
  d.x = f.a * d_column + f.b * d_row;
  d.y = f.b * d_column + f.c * d_row;
  d.xx = half * (f.a * n00 + f.b * n10);
  d.xy = f.a * n01 + f.b * n11;
  d.yy = half * (f.b * n01 + f.c * n11);
  return d;
}

}  // namespace SPLAT_NS
}  // namespace splat
