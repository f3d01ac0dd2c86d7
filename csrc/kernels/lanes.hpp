// Lanes: who walks a footprint together.
//
// A row of a footprint is walked by `width` lanes, one pixel each. On the CPU the lanes are the
// elements of one Pack and `Value` is that Pack; on CUDA they are threads of a warp and `Value`
// is each thread's own number. The kernels are written once against these four names:
//
//   L::Value   a number for each lane          L::index()   0, 1, .. width-1
//   L::width   how many lanes                  L::sum(v)    over the lanes (CUDA: valid in every lane)
#pragma once

#include "math/pack.hpp"

namespace splat {
inline namespace SPLAT_NS {

#if defined(__CUDACC__)

// Width consecutive threads of a warp; 32 / Width splats share it. Every thread of the warp must come to `sum`.
template <class T, int Width>
struct WarpLanes {
  using Scalar = T;
  using Value = T;
  static constexpr int width = Width;
  static __device__ __forceinline__ T index() { return static_cast<T>(threadIdx.x & (Width - 1)); }
  static __device__ __forceinline__ T sum(T v) {
    for (int step = Width / 2; step > 0; step >>= 1) v += __shfl_xor_sync(0xffffffffu, v, step);
    return v;
  }
};

#else

#if defined(__AVX512F__)
inline constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
inline constexpr int kRegisterBytes = 32;
#else
inline constexpr int kRegisterBytes = 16;
#endif

template <class T>
struct PackLanes {
  using Scalar = T;
  static constexpr int width = kRegisterBytes / static_cast<int>(sizeof(T));
  using Value = Pack<T, width>;
  static SPLAT_HD Value index() {
    Value r;
    for (int i = 0; i < width; ++i) r.v[i] = static_cast<T>(i);
    return r;
  }
  static SPLAT_HD T sum(Value v) { return sum_of(v); }
};

#endif

}  // namespace SPLAT_NS
}  // namespace splat
