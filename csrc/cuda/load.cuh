// Between records in global memory and single Gaussians; and sums that do not depend on their order.
#pragma once

#include "api.hpp"
#include "math/camera.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
__device__ __forceinline__ Gaussian<T> load_one(const SplatsIn<T>& s, int64_t n) {
  Gaussian<T> g;
  g.mean = {s.means[3 * n], s.means[3 * n + 1], s.means[3 * n + 2]};
  for (int k = 0; k < 3; ++k) g.scale[k] = s.scales[3 * n + k];
  for (int k = 0; k < 4; ++k) g.quat[k] = s.quats[4 * n + k];
  g.density = s.density[n];
  return g;
}

template <class T>
__device__ __forceinline__ void store_one(const SplatsOut<T>& out, int64_t n, const GaussianGradient<T>& v) {
  out.means[3 * n] = v.mean.x, out.means[3 * n + 1] = v.mean.y, out.means[3 * n + 2] = v.mean.z;
  for (int k = 0; k < 3; ++k) out.scales[3 * n + k] = v.scale[k];
  for (int k = 0; k < 4; ++k) out.quats[4 * n + k] = v.quat[k];
  out.density[n] = v.density;
}

template <class T>
__device__ __forceinline__ GaussianGradient<T> no_gradient() {
  const T zero(0);
  return {{zero, zero, zero}, {zero, zero, zero}, {zero, zero, zero, zero}, zero, {zero, zero, zero}, zero, zero};
}

// Adding floats in whatever order threads arrive gives other bits each time. Integers do not care: pixels and
// voxels are summed in units of 2^-40 (1e-12; a float32 line integral of 1 has a last digit of 1e-7) and may reach
// 2^23. Line integrals are of order 1, densities of order 0.01 to 1.
inline constexpr double kUnitsPerOne = 1099511627776.0;

template <class T>
__device__ __forceinline__ void add_exactly(unsigned long long* sum, T value) {
  const long long units = llrint(static_cast<double>(value) * kUnitsPerOne);
  if (units != 0) atomicAdd(sum, static_cast<unsigned long long>(units));
}

template <class T>
__device__ __forceinline__ T from_units(unsigned long long sum) {
  return static_cast<T>(static_cast<double>(static_cast<long long>(sum)) / kUnitsPerOne);
}

}  // namespace SPLAT_NS
}  // namespace splat
