// Gauss-Newton sums of one view, band by band.
//
// A band of detector rows and its twelve derivative images live in a scratch of a few hundred kilobytes
// that stays in cache; the 12x12 sums are taken and the band is forgotten.
#pragma once

#include "cpu/renderer.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kPairs = kDirections * (kDirections + 1) / 2;
inline constexpr int kSums = kPairs + kDirections + 4;

// Draws value and derivatives: 2^(..) times a quadratic in (dx, dy) for each direction.
template <class T>
struct AddMotion {
  using P = typename PackLanes<T>::Value;
  T* images;       // [1 + kDirections] of rows x stride, row `top` first
  long stride, plane;
  int top;
  P amplitude;
  const T* c;      // [kMotion]
  SPLAT_HD void operator()(int x, int y, P dx, T dy, P e) {
    T* at = images + (y - top) * stride + x;
    const P value = amplitude * e;
    (P::load(at) + value).store(at);
    for (int k = 0; k < kDirections; ++k) {
      const T* q = c + 6 * k;
      const P d = P(q[0] + dy * (q[2] + dy * q[5])) + dx * (P(q[1] + dy * q[4]) + dx * P(q[3]));
      T* to = at + (k + 1) * plane;
      (P::load(to) + value * d).store(to);
    }
  }
};

// Sums one row of a band: weights w = slope(r) / r of the Huber loss, times the mask.
template <class T>
inline void add_normal_row(const T* images, long plane, const T* target, const T* mask, int cols, T delta,
                           double* sums /* [kSums] */) {
  using P = typename PackLanes<T>::Value;
  constexpr int N = PackLanes<T>::width;
  P acc[kSums];
  for (P& a : acc) a = P(T(0));
  for (int x = 0; x < cols; x += N) {
    T want[N], weight[N], on[N];
    const int n = cols - x < N ? cols - x : N;
    for (int i = 0; i < N; ++i) {
      const T w = i < n ? (mask ? mask[x + i] : T(1)) : T(0);
      want[i] = i < n ? target[x + i] : T(0);
      const T r = images[x + i] - want[i], size = r < T(0) ? -r : r;
      weight[i] = size > delta ? w * delta / size : w;
      on[i] = w;
    }
    const P w = P::load(weight), m = P::load(on), r = P::load(images + x) - P::load(want);
    P d[kDirections];
    int at = 0;
    for (int k = 0; k < kDirections; ++k) {
      d[k] = P::load(images + (k + 1) * plane + x);
      const P wd = w * d[k];
      for (int l = 0; l <= k; ++l) acc[at++] += wd * d[l];
      acc[kPairs + k] += wd * r;
    }
    acc[kPairs + kDirections + 0] += w * r * r;
    acc[kPairs + kDirections + 1] += m * r * r;
    acc[kPairs + kDirections + 2] += m * max_of(r, -r);
    acc[kPairs + kDirections + 3] += m;
  }
  for (int k = 0; k < kSums; ++k)
    for (int i = 0; i < N; ++i) sums[k] += acc[k].v[i];
}

template <class T>
MotionNormal CpuRenderer<T>::motion_normal(const FrameIn& frame, const SplatsIn<T>& splats, const T* target,
                                           const T* mask, double huber_delta) {
  stamp(frame, splats, true);
  bin(splats.count);
  const Stamp<T>* stamps = stamps_.data();
  const T* coefficients = motion_.data();
  const long plane = static_cast<long>(kBand) * stride_;
  double* partial = partial_.reserve(static_cast<size_t>(bands_) * kSums);
#pragma omp parallel num_threads(threads_)
  {
    Buffer<T> scratch;
    T* images = scratch.reserve((1 + kDirections) * plane);
#pragma omp for schedule(dynamic, 1)
    for (int b = 0; b < bands_; ++b) {
      const int top = b * kBand, bottom = top + kBand < rows_ ? top + kBand : rows_;
      memset(images, 0, (1 + kDirections) * plane * sizeof(T));
      for (int64_t i = band_start_[b]; i < band_start_[b + 1]; ++i) {
        const int32_t n = band_order_[i];
        const T* c = coefficients + static_cast<size_t>(n) * kMotion;
        AddMotion<T> add{images, stride_, plane, top, P(stamps[n].amplitude), c};
        walk<L>(stamps[n], top, bottom, add);
      }
      double* sums = partial + static_cast<size_t>(b) * kSums;
      for (int k = 0; k < kSums; ++k) sums[k] = 0;
      for (int y = top; y < bottom; ++y) {
        const size_t at = static_cast<size_t>(y) * cols_;
        add_normal_row(images + (y - top) * stride_, plane, target + at, mask ? mask + at : nullptr, cols_,
                       T(huber_delta), sums);
      }
    }
  }
  double sums[kSums] = {};
  for (int b = 0; b < bands_; ++b)
    for (int k = 0; k < kSums; ++k) sums[k] += partial[static_cast<size_t>(b) * kSums + k];
  MotionNormal normal;
  for (int k = 0, at = 0; k < kDirections; ++k)
    for (int l = 0; l <= k; ++l) normal.hessian[kDirections * k + l] = normal.hessian[kDirections * l + k] = sums[at++];
  for (int k = 0; k < kDirections; ++k) normal.gradient[k] = sums[kPairs + k];
  normal.weighted_ss = sums[kPairs + kDirections + 0];
  normal.residual_ss = sums[kPairs + kDirections + 1];
  normal.residual_abs = sums[kPairs + kDirections + 2];
  normal.pixels = sums[kPairs + kDirections + 3];
  return normal;
}

}  // namespace SPLAT_NS
}  // namespace splat
