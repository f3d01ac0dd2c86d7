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
  Vec3<T> spread;        // change of q2 along the half axes (cone)
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
    p.spread = {dot(view.k2, p.half_axis[0]), dot(view.k2, p.half_axis[1]), dot(view.k2, p.half_axis[2])};
    p.clearance = dot(view.k2, p.offset) - T(4) * sqrt_of(dot(p.spread, p.spread));
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
  T column, row;   // dL/d(projected centre), per px
};

template <class T>
SPLAT_HD GaussianGradient<T> project_vjp(const View<T>& view, const Gaussian<T>& g, const Projected<T>& p,
                                         const Moments<T>& m) {
  GaussianGradient<T> v;
  const Footprint<T>& f = p.foot;
  const T amplitude = f.amplitude;
  const T v_column = amplitude * (f.a * m.x + f.b * m.y);
  const T v_row = amplitude * (f.b * m.x + f.c * m.y);
  v.column = v_column;
  v.row = v_row;
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
SPLAT_HD Moments<T> operator*(T s, const Moments<T>& a) {
  return {s * a.one, s * a.x, s * a.y, s * a.xx, s * a.xy, s * a.yy};
}
template <class T>
SPLAT_HD Moments<T> operator+(const Moments<T>& a, const Moments<T>& b) {
  return {a.one + b.one, a.x + b.x, a.y + b.y, a.xx + b.xx, a.xy + b.xy, a.yy + b.yy};
}

// d(footprint value) = value * (one + x dx + y dy + xx dx^2 + xy dx dy + yy dy^2) along all directions. Everything is
// linear in the velocity of the mean and in the turn of the half axes, so six derivatives make all twelve.
//
// With Y = dT W': dS = dT T' + T dT', dQ = -Q dS Q = -(Q Y + (Q Y)'), d ln amplitude = d ln det J - tr Y.
template <class T>
SPLAT_HD Moments<T> shape_derivative(const Footprint<T>& f, T y00, T y01, T y10, T y11) {
  return {-(y00 + y11), T(0),
          T(0),         f.a * y00 + f.b * y10,
          f.a * y01 + f.b * (y00 + y11) + f.c * y10, f.b * y01 + f.c * y11};
}

template <class T>
SPLAT_HD void motion_derivatives(const View<T>& view, const Gaussian<T>& g, const Projected<T>& p,
                                 Moments<T> d[kDirections]) {
  const Footprint<T>& f = p.foot;
  // The mean along x, y, z. Cone: dT = -(relative change of q2) T - (change of column, row) / q2 spread', and T W' = 1.
  const T j0[3] = {p.j0.x, p.j0.y, p.j0.z}, j1[3] = {p.j1.x, p.j1.y, p.j1.z};
  const T k2[3] = {view.k2.x, view.k2.y, view.k2.z}, ray[3] = {p.offset.x, p.offset.y, p.offset.z};
  Moments<T> shift[3];
  T lean0(T(0)), lean1(T(0)), per_square(T(0));
  if (view.cone) {
    lean0 = p.inverse_depth * dot(p.spread, p.w0);
    lean1 = p.inverse_depth * dot(p.spread, p.w1);
    per_square = T(1) / dot(p.offset, p.offset);
  }
  for (int k = 0; k < 3; ++k) {
    if (view.cone) {
      const T nearer = k2[k] * p.inverse_depth;
      shift[k] = shape_derivative(f, -nearer - j0[k] * lean0, -j0[k] * lean1, -j1[k] * lean0, -nearer - j1[k] * lean1);
      shift[k].one += ray[k] * per_square - T(3) * nearer;  // d ln det J
    } else {
      shift[k] = {T(0), T(0), T(0), T(0), T(0), T(0)};
    }
    shift[k].x += f.a * j0[k] + f.b * j1[k];
    shift[k].y += f.b * j0[k] + f.c * j1[k];
  }
  // The half axes about x, y, z: dT = J dM, dM = unit x M, so Y_ij = unit . (M w_j x J_i).
  Vec3<T> n0 = p.w0.x * p.half_axis[0], n1 = p.w1.x * p.half_axis[0];
  n0 = n0 + p.w0.y * p.half_axis[1] + p.w0.z * p.half_axis[2];
  n1 = n1 + p.w1.y * p.half_axis[1] + p.w1.z * p.half_axis[2];
  const Vec3<T> y00 = cross(n0, p.j0), y01 = cross(n1, p.j0), y10 = cross(n0, p.j1), y11 = cross(n1, p.j1);
  const T x = g.mean.x, y = g.mean.y, z = g.mean.z;
  d[0] = shape_derivative(f, y00.x, y01.x, y10.x, y11.x) + y * shift[2] + (-z) * shift[1];
  d[1] = shape_derivative(f, y00.y, y01.y, y10.y, y11.y) + z * shift[0] + (-x) * shift[2];
  d[2] = shape_derivative(f, y00.z, y01.z, y10.z, y11.z) + x * shift[1] + (-y) * shift[0];
  for (int k = 0; k < 3; ++k) d[3 + k] = shift[k];
  d[6] = x * shift[0];
  d[7] = y * shift[1];
  d[8] = z * shift[2];
  d[9] = z * shift[1] + y * shift[2];
  d[10] = z * shift[0] + x * shift[2];
  d[11] = y * shift[0] + x * shift[1];
}

}  // namespace SPLAT_NS
}  // namespace splat
