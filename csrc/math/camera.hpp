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
  T clearance;           // q2 less four standard deviations of it; below 0 the Gaussian reaches the source's plane
  Vec3<T> t0, t1;        // rows of T = J2 M, px
  Vec3<T> w0, w1;        // rows of W = S^-1 T, 1/px
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
  for (int k = 0; k < 3; ++k) p.half_axis[k] = g.scale[k] * p.axes.column[k];
  p.clearance = T(1);
  if (view.cone) {
    const Vec3<T> spread{dot(view.k2, p.half_axis[0]), dot(view.k2, p.half_axis[1]), dot(view.k2, p.half_axis[2])};
    p.clearance = dot(view.k2, p.offset) - T(4) * sqrt_of(dot(spread, spread));
  }
  p.t0 = {dot(p.j0, p.half_axis[0]), dot(p.j0, p.half_axis[1]), dot(p.j0, p.half_axis[2])};
  p.t1 = {dot(p.j1, p.half_axis[0]), dot(p.j1, p.half_axis[1]), dot(p.j1, p.half_axis[2])};
  const Vec3<T> normal = cross(p.t0, p.t1);
  const T inverse_det = T(1) / dot(normal, normal);
  p.w0 = inverse_det * cross(p.t1, normal);
  p.w1 = inverse_det * cross(normal, p.t0);
  p.foot.column = p.column_rel + view.column0;
  p.foot.row = p.row_rel + view.row0;
  p.foot.a = dot(p.t1, p.t1) * inverse_det;
  p.foot.b = -dot(p.t0, p.t1) * inverse_det;
  p.foot.c = dot(p.t0, p.t0) * inverse_det;
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
  // With Q = S^-1 and M2 the second moments: dL/dS = amplitude (Q M2 Q - one Q) / 2, of which the first term is the
  // footprint's shape and the second the amplitude's 1/sqrt(det S); so dL/dT = 2 dL/dS T = amplitude (Q M2 - one) W.
  const T along = m.one * amplitude;  // amplitude dL/damplitude = dL/d(ln amplitude)
  const T h00 = amplitude * (f.a * m.xx + f.b * m.xy) - along, h01 = amplitude * (f.a * m.xy + f.b * m.yy);
  const T h10 = amplitude * (f.b * m.xx + f.c * m.xy), h11 = amplitude * (f.b * m.xy + f.c * m.yy) - along;
  const Vec3<T> v_t0 = h00 * p.w0 + h01 * p.w1, v_t1 = h10 * p.w0 + h11 * p.w1;
  const T to0[3] = {v_t0.x, v_t0.y, v_t0.z}, to1[3] = {v_t1.x, v_t1.y, v_t1.z};
  Vec3<T> v_j0{T(0), T(0), T(0)}, v_j1{T(0), T(0), T(0)};
  Axes<T> v_axes;
  v.torque = {T(0), T(0), T(0)};
  for (int k = 0; k < 3; ++k) {
    v_j0 = v_j0 + to0[k] * p.half_axis[k];
    v_j1 = v_j1 + to1[k] * p.half_axis[k];
    const Vec3<T> v_half = to0[k] * p.j0 + to1[k] * p.j1;
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
  Vec3<T> d_half[3] = {{zero, zero, zero}, {zero, zero, zero}, {zero, zero, zero}};
  for (int k = 0; turn && k < 3; ++k) d_half[k] = cross(unit, p.half_axis[k]);
  Vec3<T> d_t0{dot(d_j0, p.half_axis[0]) + dot(p.j0, d_half[0]), dot(d_j0, p.half_axis[1]) + dot(p.j0, d_half[1]),
               dot(d_j0, p.half_axis[2]) + dot(p.j0, d_half[2])};
  Vec3<T> d_t1{dot(d_j1, p.half_axis[0]) + dot(p.j1, d_half[0]), dot(d_j1, p.half_axis[1]) + dot(p.j1, d_half[1]),
               dot(d_j1, p.half_axis[2]) + dot(p.j1, d_half[2])};
  // With Y = dT W': dS = dT T' + T dT', dQ = -Q dS Q = -(Q Y + (Q Y)'), d ln amplitude = d ln det J - tr Y.
  const T y00 = dot(d_t0, p.w0), y01 = dot(d_t0, p.w1), y10 = dot(d_t1, p.w0), y11 = dot(d_t1, p.w1);
  const Footprint<T>& f = p.foot;
  Moments<T> d;
  d.one = d_log - (y00 + y11);
  d.x = f.a * d_column + f.b * d_row;
  d.y = f.b * d_column + f.c * d_row;
  d.xx = f.a * y00 + f.b * y10;
  d.xy = f.a * y01 + f.b * (y00 + y11) + f.c * y10;
  d.yy = f.b * y01 + f.c * y11;
  return d;
}

}  // namespace SPLAT_NS
}  // namespace splat
