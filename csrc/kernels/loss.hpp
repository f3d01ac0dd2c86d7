// Image losses: Huber with its slope, and the window of SSIM.
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

}  // namespace SPLAT_NS
}  // namespace splat
