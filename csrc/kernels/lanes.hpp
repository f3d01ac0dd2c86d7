// Lanes: who walks a footprint together.
//
// A footprint is walked by `count` lanes, one pixel each, that form a tile of `width` columns and `height` rows. On
// the CPU the lanes are the elements of one Pack and `Value` is that Pack; on CUDA they are threads of a warp and
// `Value` is each thread's own number. Footprints are about eight pixels wide, so a register of sixteen numbers takes
// two rows of eight rather than one of sixteen. The kernels are written once against these names:
//
//   L::Value    a number for each lane            L::index()    0, 1, .. count-1
//   L::count    how many lanes                    L::column()   the lane's column in its tile, 0 .. width-1
//   L::width, L::height                           L::row()      its row, 0 .. height-1
//   L::sum(v)   over the lanes (CUDA: valid in every lane)
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
  static constexpr int count = Width, width = Width, height = 1;
  static __device__ __forceinline__ T index() { return static_cast<T>(threadIdx.x & (Width - 1)); }
  static __device__ __forceinline__ T column() { return index(); }
  static __device__ __forceinline__ T row() { return T(0); }
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
inline constexpr int kLanesOf = kRegisterBytes / static_cast<int>(sizeof(T));

// The rows of a tile lie interleaved in a register (and in memory, see cpu/woven.hpp): lane = height column + row.
template <class T, int Count = kLanesOf<T>>
struct PackLanes {
  using Scalar = T;
  static constexpr int count = Count, height = Count > 8 ? 2 : 1, width = Count / height;
  using Value = Pack<T, Count>;
  static SPLAT_HD Value index() {
    Value r;
    for (int i = 0; i < count; ++i) r.v[i] = static_cast<T>(i);
    return r;
  }
  static SPLAT_HD Value column() {
    Value r;
    for (int i = 0; i < count; ++i) r.v[i] = static_cast<T>(i / height);
    return r;
  }
  static SPLAT_HD Value row() {
    Value r;
    for (int i = 0; i < count; ++i) r.v[i] = static_cast<T>(i % height);
    return r;
  }
  static SPLAT_HD T sum(Value v) { return sum_of(v); }
};

#endif

}  // namespace SPLAT_NS
}  // namespace splat
