// Pack<T, N>: N numbers that move together, one SIMD register (or two) on the CPU.
//
// Everything in math/ and the inner loops in kernels/ is templated on a number type. On the CPU
// that type is a Pack, on CUDA it is a plain float whose "pack" is the warp: see kernels/lanes.hpp.
// GCC and Clang compile vector types to the target's registers, whatever their width.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "platform.hpp"

namespace splat {
inline namespace SPLAT_NS {

// ---- plain numbers: the scalar meaning of every function below -----------------------------------

SPLAT_HD float sqrt_of(float x) { return sqrtf(x); }
SPLAT_HD double sqrt_of(double x) { return sqrt(x); }
SPLAT_HD float exp_of(float x) { return expf(x); }
SPLAT_HD double exp_of(double x) { return exp(x); }
template <class T>
SPLAT_HD T select(bool condition, T yes, T no) { return condition ? yes : no; }
template <class T>
SPLAT_HD T max_of(T a, T b) { return a > b ? a : b; }
template <class T>
SPLAT_HD T min_of(T a, T b) { return a < b ? a : b; }

// 2^x for x in [-120, 0]: round to the nearest integer n, a polynomial for 2^(x-n) on [-1/2, 1/2]
// (degree 5, relative error 1e-7), and n added to the exponent bits. The same text on every
// device, so that CPU and GPU agree. Doubles take the library's.
SPLAT_HD double exp2_of(double x) { return exp2(x); }

// 2^f on [-1/2, 1/2], Chebyshev fit. V: float or a pack of floats.
template <class V>
SPLAT_HD V exp2_of_fraction(V f) {
  V y(1.340043217e-03f);
  y = y * f + V(9.676037098e-03f);
  y = y * f + V(5.550327214e-02f);
  y = y * f + V(2.402210736e-01f);
  y = y * f + V(6.931472067e-01f);
  return y * f + V(1.000000075e+00f);
}

SPLAT_HD float exp2_of(float x) {
  const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
  const float shifted = x + magic;
  const float f = x - (shifted - magic);
  float y = exp2_of_fraction(f);
  int32_t bits, exponent;
  memcpy(&bits, &shifted, 4);
  memcpy(&exponent, &y, 4);
  exponent += static_cast<int32_t>(static_cast<uint32_t>(bits) << 23);
  memcpy(&y, &exponent, 4);
  return y;
}

#if !defined(__CUDACC__)

// Vector types by name: GCC does not tell apart vector types whose size depends on a template parameter.
// Register is naturally aligned; Memory is the same at any address.
template <class T, int N>
struct VectorOf;
#define SPLAT_VECTOR(T, I, N)                                                              \
  template <>                                                                              \
  struct VectorOf<T, N> {                                                                  \
    typedef T Register __attribute__((vector_size(N * sizeof(T))));                        \
    typedef I Mask __attribute__((vector_size(N * sizeof(T))));                            \
    typedef T Memory __attribute__((vector_size(N * sizeof(T)), aligned(sizeof(T)), may_alias)); \
  };
SPLAT_VECTOR(float, int32_t, 1)
SPLAT_VECTOR(float, int32_t, 4)
SPLAT_VECTOR(float, int32_t, 8)
SPLAT_VECTOR(float, int32_t, 16)
SPLAT_VECTOR(double, int64_t, 1)
SPLAT_VECTOR(double, int64_t, 2)
SPLAT_VECTOR(double, int64_t, 4)
SPLAT_VECTOR(double, int64_t, 8)
#undef SPLAT_VECTOR

template <class T, int N>
struct Pack {
  using Scalar = T;
  static constexpr int size = N;
  using Register = typename VectorOf<T, N>::Register;
  using Memory = typename VectorOf<T, N>::Memory;
  using Mask = typename VectorOf<T, N>::Mask;
  Register v;

  SPLAT_HD Pack() = default;
  SPLAT_HD Pack(Register r) : v(r) {}
  SPLAT_HD Pack(T x) : v(x - Register{}) {}

  static SPLAT_HD Pack load(const T* p) { return Pack(Register(*reinterpret_cast<const Memory*>(p))); }
  SPLAT_HD void store(T* p) const { *reinterpret_cast<Memory*>(p) = v; }
  // One lane from each of N records that lie `stride` numbers apart.
  static SPLAT_HD Pack gather(const T* p, int stride) {
    Pack r;
    for (int i = 0; i < N; ++i) r.v[i] = p[i * stride];
    return r;
  }
  SPLAT_HD void scatter(T* p, int stride) const {
    for (int i = 0; i < N; ++i) p[i * stride] = v[i];
  }

  SPLAT_HD Pack operator-() const { return Pack(-v); }
  SPLAT_HD Pack& operator+=(Pack b) { v += b.v; return *this; }
  SPLAT_HD Pack& operator-=(Pack b) { v -= b.v; return *this; }
  SPLAT_HD Pack& operator*=(Pack b) { v *= b.v; return *this; }
  friend SPLAT_HD Pack operator+(Pack a, Pack b) { return Pack(a.v + b.v); }
  friend SPLAT_HD Pack operator-(Pack a, Pack b) { return Pack(a.v - b.v); }
  friend SPLAT_HD Pack operator*(Pack a, Pack b) { return Pack(a.v * b.v); }
  friend SPLAT_HD Pack operator/(Pack a, Pack b) { return Pack(a.v / b.v); }
  friend SPLAT_HD Mask operator<(Pack a, Pack b) { return a.v < b.v; }
  friend SPLAT_HD Mask operator>(Pack a, Pack b) { return a.v > b.v; }
};

template <class T, int N>
SPLAT_HD Pack<T, N> sqrt_of(Pack<T, N> x) {
  for (int i = 0; i < N; ++i) x.v[i] = std::sqrt(x.v[i]);
  return x;
}
template <class T, int N>
SPLAT_HD Pack<T, N> exp_of(Pack<T, N> x) {
  for (int i = 0; i < N; ++i) x.v[i] = std::exp(x.v[i]);
  return x;
}
template <class T, int N>
SPLAT_HD Pack<T, N> select(typename Pack<T, N>::Mask condition, Pack<T, N> yes, Pack<T, N> no) {
  return Pack<T, N>(condition ? yes.v : no.v);
}
template <class T, int N>
SPLAT_HD Pack<T, N> max_of(Pack<T, N> a, Pack<T, N> b) { return select(a > b, a, b); }
template <class T, int N>
SPLAT_HD Pack<T, N> min_of(Pack<T, N> a, Pack<T, N> b) { return select(a < b, a, b); }

// The sum of the elements, halves first: a fixed order for each N.
template <class T, int N>
SPLAT_HD T sum_of(Pack<T, N> x) {
  if constexpr (N * sizeof(T) > 16) {
    typename VectorOf<T, N / 2>::Register half[2];
    memcpy(half, &x.v, sizeof half);
    return sum_of(Pack<T, N / 2>(half[0] + half[1]));
  } else if constexpr (N == 4) {
    return (x.v[0] + x.v[2]) + (x.v[1] + x.v[3]);
  } else {
    return x.v[0] + x.v[1];
  }
}

template <int N>
SPLAT_HD Pack<float, N> exp2_of(Pack<float, N> x) {
  using P = Pack<float, N>;
  const P magic(12582912.0f);
  const P shifted = x + magic;
  const P f = x - (shifted - magic);
  const P y = exp2_of_fraction(f);
  using Bits = typename P::Mask;
  return P((typename P::Register)((Bits)y.v + ((Bits)shifted.v << 23)));
}
template <int N>
SPLAT_HD Pack<double, N> exp2_of(Pack<double, N> x) {
  for (int i = 0; i < N; ++i) x.v[i] = std::exp2(x.v[i]);
  return x;
}

#endif  // !__CUDACC__

}  // namespace SPLAT_NS
}  // namespace splat
