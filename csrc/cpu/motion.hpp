// Gauss-Newton sums of one view, band by band.
//
// A band of detector rows and its twelve derivative images live in a scratch of a few hundred kilobytes
// that stays in cache; the 12x12 sums are taken and the band is forgotten.
#pragma once

#include "cpu/renderer.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kRows = 1 + kDirections;         // the residual and its derivatives
inline constexpr int kSums = kRows * kRows + 3;       // their products; r^2, |r| and pixels

// Draws value and derivatives: 2^(..) times a quadratic in (dx, dy) for each direction.
template <class T>
struct AddMotion {
  using P = typename PackLanes<T>::Value;
  T* images;       // [kRows] of rows x stride, row `top` first
  long stride, plane;
  int top;
  P amplitude;
  const T* c;      // [kMotion]
  P flat[kDirections], lean[kDirections];  // of the present columns: what dy^0 and dy^1 have as factors
  SPLAT_HD void enter(P dx) {
    for (int k = 0; k < kDirections; ++k) {
      const T* q = c + 6 * k;
      flat[k] = P(q[0]) + dx * (P(q[1]) + dx * P(q[3]));
      lean[k] = P(q[2]) + dx * P(q[4]);
    }
  }
  SPLAT_HD void leave(P) {}
  SPLAT_HD void operator()(int x, int y, P, T dy, P e) {
    T* at = images + (y - top) * stride + x;
    const P value = amplitude * e, down(dy);
    (P::load(at) + value).store(at);
    for (int k = 0; k < kDirections; ++k) {
      const P d = flat[k] + down * (lean[k] + down * P(c[6 * k + 5]));
      T* to = at + (k + 1) * plane;
      (P::load(to) + value * d).store(to);
    }
  }
};

// sums[i * kRows + j] += <a_i, b_j> for m x n rows that lie `plane` apart.
template <int m, int n, class T>
inline void add_products(const T* a, const T* b, long plane, int cols, double* sums) {
  using P = typename PackLanes<T>::Value;
  P acc[m * n];
  for (P& s : acc) s = P(T(0));
  for (int x = 0; x < cols; x += P::size) {
    P u[m], v[n];
    for (int i = 0; i < m; ++i) u[i] = P::load(a + i * plane + x);
    for (int j = 0; j < n; ++j) v[j] = P::load(b + j * plane + x);
    for (int i = 0; i < m; ++i)
      for (int j = 0; j < n; ++j) acc[i * n + j] += u[i] * v[j];
  }
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < n; ++j) sums[i * kRows + j] += sum_of(acc[i * n + j]);
}

// Sums one row of a band, which it overwrites: residual and derivatives times the root of the weight, then their
// products four by four, as many as registers hold. The weight is slope(r) / r of the Huber loss times the mask.
template <class T>
inline void add_normal_row(T* images, long plane, const T* target, const T* mask, int cols, T delta,
                           double* sums /* [kSums], of the products only those with i >= j or both in one block */) {
  using P = typename PackLanes<T>::Value;
  constexpr int N = PackLanes<T>::width;
  P squares(T(0)), sizes(T(0)), pixels(T(0));
  for (int x = 0; x < cols; x += N) {
    T want[N], on[N];
    const int n = cols - x < N ? cols - x : N;
    for (int i = 0; i < N; ++i) {
      want[i] = i < n ? target[x + i] : T(0);
      on[i] = i < n ? (mask ? mask[x + i] : T(1)) : T(0);
    }
    const P m = P::load(on), r = P::load(images + x) - P::load(want), size = max_of(r, -r);
    squares += m * r * r;
    sizes += m * size;
    pixels += m;
    const P root = sqrt_of(select(size > P(delta), m * P(delta) / size, m));
    (root * r).store(images + x);
    for (int k = 1; k < kRows; ++k) (root * P::load(images + k * plane + x)).store(images + k * plane + x);
  }
  const T* d = images + plane;
  double* products = sums + kRows + 1;
  add_products<kRows, 1>(images, images, plane, cols, sums);
  for (int i = 0; i < kDirections; i += 4)
    for (int j = 0; j <= i; j += 4)
      add_products<4, 4>(d + i * plane, d + j * plane, plane, cols, products + i * kRows + j);
  sums[kRows * kRows] += sum_of(squares);
  sums[kRows * kRows + 1] += sum_of(sizes);
  sums[kRows * kRows + 2] += sum_of(pixels);
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
    T* images = scratch.reserve(kRows * plane);
#pragma omp for schedule(dynamic, 1)
    for (int b = 0; b < bands_; ++b) {
      const int top = b * kBand, bottom = top + kBand < rows_ ? top + kBand : rows_;
      memset(images, 0, kRows * plane * sizeof(T));
      const int64_t end = band_start_[b + 1];
      for (int64_t i = band_start_[b]; i < end; ++i) {
        const int32_t n = band_order_[i];
        if (i + 1 < end) {
          const int64_t next = band_order_[i + 1];
          __builtin_prefetch(stamps + next);
          for (int k = 0; k < kMotion; k += 64 / sizeof(T)) __builtin_prefetch(coefficients + next * kMotion + k);
        }
        const T* c = coefficients + static_cast<size_t>(n) * kMotion;
        AddMotion<T> add{images, stride_, plane, top, P(stamps[n].amplitude), c, {}, {}};
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
  for (int k = 0; k < kDirections; ++k) {
    normal.gradient[k] = sums[(k + 1) * kRows];
    for (int l = 0; l <= k; ++l)
      normal.hessian[kDirections * k + l] = normal.hessian[kDirections * l + k] = sums[(k + 1) * kRows + l + 1];
  }
  normal.weighted_ss = sums[0];
  normal.residual_ss = sums[kRows * kRows];
  normal.residual_abs = sums[kRows * kRows + 1];
  normal.pixels = sums[kRows * kRows + 2];
  return normal;
}

}  // namespace SPLAT_NS
}  // namespace splat
