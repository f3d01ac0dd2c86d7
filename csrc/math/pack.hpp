// Pack<T, N>: N numbers that move together, one SIMD register (or two) on the CPU.
//
// Everything in math/ and the inner loops in kernels/ is templated on a number type. On the CPU
// that type is a Pack, on CUDA it is a plain float whose "pack" is the warp: see kernels/lanes.hpp.
// GCC and Clang compile vector types to the target's registers, whatever their width.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <utility>

#include "platform.hpp"

namespace splat {
inline namespace SPLAT_NS {

// ---- plain numbers: the scalar meaning of every function below -----------------------------------

SPLAT_HD float sqrt_of(float x) { return sqrtf(x); }
SPLAT_HD double sqrt_of(double x) { return sqrt(x); }
template <class T>
SPLAT_HD T select(bool condition, T yes, T no) { return condition ? yes : no; }
template <class T>
SPLAT_HD T max_of(T a, T b) { return a > b ? a : b; }
template <class T>
SPLAT_HD T min_of(T a, T b) { return a < b ? a : b; }

// 2^x for x in [-126, 127]: round to the nearest integer n, a polynomial for 2^(x-n) on [-1/2, 1/2]
// (degree 6, relative error 2e-9, so that rounding is all the error there is), and n added to the exponent
// bits. The same text on every device, so that CPU and GPU agree. Doubles take the library's.
SPLAT_HD double exp2_of(double x) { return exp2(x); }

// 2^f on [-1/2, 1/2], of least relative error with the constant held at 1. V: float or a pack of floats.
template <class V>
SPLAT_HD V exp2_of_fraction(V f) {
  V y(1.535336188e-04f);
  y = y * f + V(1.339887442e-03f);
  y = y * f + V(9.618437358e-03f);
  y = y * f + V(5.550332471e-02f);
  y = y * f + V(2.402264791e-01f);
  y = y * f + V(6.931472029e-01f);
  return y * f + V(1.0f);
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

// e^x and ln(1 + x), x in [0, 1], for loops that the compiler makes vectors of: no calls, no branches.
SPLAT_HD double exp_of(double x) { return exp(x); }
SPLAT_HD float exp_of(float x) {
  // x - n ln 2 with ln 2 in two parts, of which n times the first is exact.
  const float kept = min_of(max_of(x, -87.0f), 88.0f), magic = 12582912.0f;
  const float shifted = kept * 1.442695041f + magic, n = shifted - magic;
  const float rest = (kept - n * 0.693359375f) + n * 2.121944401e-4f;
  float y = exp2_of_fraction(rest * 1.442695041f);
  int32_t bits, exponent;
  memcpy(&bits, &shifted, 4);
  memcpy(&exponent, &y, 4);
  exponent += static_cast<int32_t>(static_cast<uint32_t>(bits) << 23);
  memcpy(&y, &exponent, 4);
  return y;
}
SPLAT_HD double log1p_of(double x) { return log1p(x); }
// 2 atanh(x / (2 + x)), whose argument is at most 1/3: eight terms of its series leave 2e-9.
SPLAT_HD float log1p_of(float x) {
  const float s = x / (2.0f + x), z = s * s;
  float y = 1.0f / 15;
  y = y * z + 1.0f / 13;
  y = y * z + 1.0f / 11;
  y = y * z + 1.0f / 9;
  y = y * z + 1.0f / 7;
  y = y * z + 1.0f / 5;
  y = y * z + 1.0f / 3;
  return 2 * s * (y * z + 1.0f);
}

// x to an integer, for |x| below 2^22 (float) or 2^51: adding and taking away 1.5 * 2^23 rounds to the nearest one.
template <class V>
SPLAT_HD V rounded(V x, float) { return (x + V(12582912.0f)) - V(12582912.0f); }
template <class V>
SPLAT_HD V rounded(V x, double) { return (x + V(6755399441055744.0)) - V(6755399441055744.0); }
template <class T, class V>
SPLAT_HD V floor_of(V x) {
  const V r = rounded(x, T(0));
  return r - select(r > x, V(T(1)), V(T(0)));
}
template <class T, class V>
SPLAT_HD V ceil_of(V x) {
  const V r = rounded(x, T(0));
  return r + select(r < x, V(T(1)), V(T(0)));
}

// Integers of a number's size, towards zero.
template <class T>
struct WholeOf;
template <>
struct WholeOf<float> {
  using Type = int32_t;
};
template <>
struct WholeOf<double> {
  using Type = int64_t;
};
SPLAT_HD int32_t whole_of(float x) { return static_cast<int32_t>(x); }
SPLAT_HD int64_t whole_of(double x) { return static_cast<int64_t>(x); }

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
  friend SPLAT_HD Mask operator<=(Pack a, Pack b) { return a.v <= b.v; }
  friend SPLAT_HD Mask operator>=(Pack a, Pack b) { return a.v >= b.v; }
  friend SPLAT_HD Mask operator==(Pack a, Pack b) { return a.v == b.v; }
  friend SPLAT_HD Mask operator!=(Pack a, Pack b) { return a.v != b.v; }
};

template <class T, int N>
struct WholeOf<Pack<T, N>> {
  using Type = typename Pack<T, N>::Mask;
};
template <class T, int N>
SPLAT_HD typename Pack<T, N>::Mask whole_of(Pack<T, N> x) {
  return __builtin_convertvector(x.v, typename Pack<T, N>::Mask);
}
template <class T, int N>
SPLAT_HD Pack<T, N> sqrt_of(Pack<T, N> x) {
  for (int i = 0; i < N; ++i) x.v[i] = std::sqrt(x.v[i]);
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

// Lane i is lane Pick(i) of a, or lane Pick(i) - N of b.
template <auto Pick, class T, int N, int... i>
SPLAT_HD Pack<T, N> merge_lanes(Pack<T, N> a, Pack<T, N> b, std::integer_sequence<int, i...>) {
#if defined(__clang__)
  return Pack<T, N>(__builtin_shufflevector(a.v, b.v, Pick(i)...));
#else
  return Pack<T, N>(__builtin_shuffle(a.v, b.v, typename Pack<T, N>::Mask{Pick(i)...}));
#endif
}
template <auto Pick, class T, int N>
SPLAT_HD Pack<T, N> merge(Pack<T, N> a, Pack<T, N> b) {
  return merge_lanes<Pick>(a, b, std::make_integer_sequence<int, N>());
}

// N records of K numbers, one after the other in K packs, to K packs of which each has one number of every record.
template <int K, int k, int s, class T, int N>
SPLAT_HD Pack<T, N> nth_of_records(const Pack<T, N>* in, Pack<T, N> done) {
  if constexpr (s == K) {
    return done;
  } else {
    constexpr auto pick = [](int i) {
      const int from = (K * i + k) / N, lane = (K * i + k) % N;
      return from == s ? N + lane : (s == 1 ? lane : i);
    };
    return nth_of_records<K, k, s + 1>(in, merge<pick>(done, in[s]));
  }
}
template <class T, int N, int K, int... k>
SPLAT_HD void each_from_records(const Pack<T, N> (&in)[K], Pack<T, N>* out, std::integer_sequence<int, k...>) {
  ((out[k] = nth_of_records<K, k, 1>(in, in[0])), ...);
}
template <class T, int N, int K>
SPLAT_HD void from_records(const T* records, Pack<T, N> (&out)[K]) {
  Pack<T, N> in[K];
  for (int k = 0; k < K; ++k) in[k] = Pack<T, N>::load(records + k * N);
  each_from_records(in, out, std::make_integer_sequence<int, K>());
}

// And back.
template <int K, int s, int k, class T, int N>
SPLAT_HD Pack<T, N> nth_to_records(const Pack<T, N>* in, Pack<T, N> done) {
  if constexpr (k == K) {
    return done;
  } else {
    constexpr auto pick = [](int i) {
      const int from = (s * N + i) % K, lane = (s * N + i) / K;
      return from == k ? N + lane : (k == 1 ? lane : i);
    };
    return nth_to_records<K, s, k + 1>(in, merge<pick>(done, in[k]));
  }
}
template <class T, int N, int K, int... s>
SPLAT_HD void each_to_records(const Pack<T, N> (&in)[K], T* records, std::integer_sequence<int, s...>) {
  (nth_to_records<K, s, 1>(in, in[0]).store(records + s * N), ...);
}
template <class T, int N, int K>
SPLAT_HD void to_records(const Pack<T, N> (&in)[K], T* records) {
  each_to_records(in, records, std::make_integer_sequence<int, K>());
}

// Swaps lane l of rows[r] with lane r of rows[l], by halves, quarters and so on: N log N merges.
template <int half, class T, int N>
SPLAT_HD void transpose_from(Pack<T, N>* rows) {
  if constexpr (half > 0) {
    for (int r = 0; r < N; ++r) {
      if (r & half) continue;
      const Pack<T, N> a = rows[r], b = rows[r + half];
      rows[r] = merge<[](int l) { return l & half ? N + l - half : l; }>(a, b);
      rows[r + half] = merge<[](int l) { return l & half ? N + l : l + half; }>(a, b);
    }
    transpose_from<half / 2>(rows);
  }
}
template <class T, int N>
SPLAT_HD void transpose(Pack<T, N> (&rows)[N]) { transpose_from<N / 2>(&rows[0]); }

// Lane r is the sum of the elements of rows[r], which are overwritten: a transposition that adds as it goes.
template <int half, class T, int N>
SPLAT_HD Pack<T, N> sums_from(Pack<T, N>* rows) {
  if constexpr (half == 0) {
    return rows[0];
  } else {
    for (int r = 0; r < half; ++r) {
      const Pack<T, N> a = rows[r], b = rows[r + half];
      rows[r] = merge<[](int l) { return l & half ? N + l - half : l; }>(a, b) +
                merge<[](int l) { return l & half ? N + l : l + half; }>(a, b);
    }
    return sums_from<half / 2>(rows);
  }
}
template <class T, int N>
SPLAT_HD Pack<T, N> sums_of_each(Pack<T, N> (&rows)[N]) { return sums_from<N / 2>(&rows[0]); }

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
