// All kernels, compiled once for each instruction set. SPLAT_NS and the flags differ, the text does not.
#include <cmath>
#include <cstdint>

#include "cpu/adam.hpp"
#include "cpu/rays.hpp"
#include "cpu/renderer.hpp"
#include "cpu/variation.hpp"
#include "cpu/voxels.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
static Renderer<T>* make_renderer(int rows, int cols, int threads) {
  return new CpuRenderer<T>(rows, cols, threads);
}

// Twelve chains hide the latency of a fused multiply-add on two pipes of up to six cycles.
template <class T>
static double peak_fma(int64_t rounds, int threads) {
  using P = typename PackLanes<T>::Value;
  constexpr int kChains = 12;
  double sink = 0;
#pragma omp parallel num_threads(threads) reduction(+ : sink)
  {
    P x[kChains];
    for (int k = 0; k < kChains; ++k) x[k] = P(T(1) + T(k) * T(1e-3));
    const P a(T(0.999999)), b(T(1e-6));
    for (int64_t i = 0; i < rounds; ++i) {
#pragma GCC unroll 12
      for (int k = 0; k < kChains; ++k) x[k] = x[k] * a + b;
    }
    for (int k = 0; k < kChains; ++k) sink += PackLanes<T>::sum(x[k]);
  }
  return sink == 12345 ? 0 : static_cast<double>(rounds) * kChains * P::size * threads;
}

template <class T>
static constexpr Core<T> kCore{make_renderer<T>, voxelize<T>, voxelize_vjp<T>, total_variation<T>, adam<T>,
                               project_volume<T>, project_volume_adjoint<T>, backproject<T>, peak_fma<T>};

const Core<float>& core_float() { return kCore<float>; }
const Core<double>& core_double() { return kCore<double>; }

}  // namespace SPLAT_NS
}  // namespace splat
