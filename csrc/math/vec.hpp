// Three-vectors over any number type.
#pragma once

#include "math/pack.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
struct Vec3 {
  T x, y, z;
  friend SPLAT_HD Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend SPLAT_HD Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend SPLAT_HD Vec3 operator*(T s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
};

template <class T>
SPLAT_HD T dot(Vec3<T> a, Vec3<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

template <class T>
SPLAT_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

}  // namespace SPLAT_NS
}  // namespace splat
