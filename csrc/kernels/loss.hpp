// Image losses and their gradients, one row at a time: Huber and D-SSIM.
#pragma once

#include "platform.hpp"

namespace splat {
inline namespace SPLAT_NS {

// huber(r) and its slope: r^2 / (2 delta) within delta, |r| - delta/2 beyond. delta -> 0 is L1.
template <class T>
SPLAT_HD void huber(T r, T delta, T inverse_delta, T& value, T& slope) {
  const T size = r < T(0) ? -r : r;
  const T scaled = r * inverse_delta;
  slope = scaled > T(1) ? T(1) : (scaled < T(-1) ? T(-1) : scaled);
  value = size < delta ? T(0.5) * r * scaled : size - T(0.5) * delta;
}

// The window of SSIM: 11 taps of a Gaussian of 1.5 px, sum 1 (Wang et al. 2004).
inline constexpr int kSsimRadius = 5;

template <class T>
struct SsimWindow {
  T tap[2 * kSsimRadius + 1];
  SsimWindow() {
    double sum = 0, w[2 * kSsimRadius + 1];
    for (int i = -kSsimRadius; i <= kSsimRadius; ++i) sum += w[i + kSsimRadius] = exp(-i * i / (2 * 1.5 * 1.5));
    for (int i = 0; i <= 2 * kSsimRadius; ++i) tap[i] = T(w[i] / sum);
  }
};

// One output row of a separable convolution with zero padding. `in` is rows x stride;
// `row` is scratch of cols + 2 radius.
template <class T>
void convolve_row(const SsimWindow<T>& w, const T* in, int rows, int cols, int stride, int y, T* row, T* out) {
  const int r = kSsimRadius;
  for (int x = 0; x < cols + 2 * r; ++x) row[x] = T(0);
  for (int k = -r; k <= r; ++k) {
    const int source = y + k;
    if (source < 0 || source >= rows) continue;
    const T* line = in + static_cast<long>(source) * stride;
    const T tap = w.tap[k + r];
    for (int x = 0; x < cols; ++x) row[x + r] += tap * line[x];
  }
  for (int x = 0; x < cols; ++x) {
    T sum(0);
    for (int k = 0; k <= 2 * r; ++k) sum += w.tap[k] * row[x + k];
    out[x] = sum;
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
