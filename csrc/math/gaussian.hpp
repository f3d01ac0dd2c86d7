// One anisotropic Gaussian of the volume, density * exp(-|M^-1 (x - mean)|^2 / 2) with M = R(q) diag(s).
#pragma once

#include "math/vec.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
struct Gaussian {
  Vec3<T> mean;       // mm
  T scale[3];         // mm, one standard deviation along each own axis
  T quat[4];          // w, x, y, z; need not be of unit length
  T density;          // 1/mm at the centre
};

// The three columns of a rotation matrix: the Gaussian's own axes in the world.
template <class T>
struct Axes {
  Vec3<T> column[3];
};

// R(q) of q / |q|.
template <class T>
SPLAT_HD Axes<T> axes_of(const T quat[4]) {
  const T inverse = T(1) / (quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
  const T w = quat[0], x = quat[1], y = quat[2], z = quat[3], two = inverse + inverse;
  Axes<T> r;
  r.column[0] = {T(1) - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)};
  r.column[1] = {two * (x * y - w * z), T(1) - two * (x * x + z * z), two * (y * z + w * x)};
  r.column[2] = {two * (x * z + w * y), two * (y * z - w * x), T(1) - two * (x * x + y * y)};
  return r;
}

// Reverse of axes_of. v_axes: dL/dR by columns. The result is tangent to the sphere of q, as the length
// of q does not matter. With L(R(q)) and B = sum_k column_k x v_column_k (the world torque), a rotation
// by dw changes L by B . dw, and dq = (0, dw) q / 2; so v_q = 2 (0, B) q / |q|^2, quaternion product.
template <class T>
SPLAT_HD void axes_of_vjp(const T quat[4], const Axes<T>& axes, const Axes<T>& v_axes, T v_quat[4]) {
  const T inverse = T(1) / (quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
  const Vec3<T> b = cross(axes.column[0], v_axes.column[0]) + cross(axes.column[1], v_axes.column[1]) +
                    cross(axes.column[2], v_axes.column[2]);
  const T w = quat[0], x = quat[1], y = quat[2], z = quat[3], two = inverse + inverse;
  v_quat[0] = two * (-(b.x * x + b.y * y + b.z * z));
  v_quat[1] = two * (b.x * w + b.y * z - b.z * y);
  v_quat[2] = two * (b.y * w + b.z * x - b.x * z);
  v_quat[3] = two * (b.z * w + b.x * y - b.y * x);
}

}  // namespace SPLAT_NS
}  // namespace splat
