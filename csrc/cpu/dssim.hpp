// The D-SSIM term of the loss and its gradient (Wang et al. 2004; window of 11 px, zero padding).
#pragma once

#include "cpu/renderer.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Row y of M separable convolutions at once. down(at, tap, sums) adds tap times the M inputs at offset `at`;
// across(x, results) takes the M outputs of columns x + lane. columns: [M, width + 2 radius], zero at both ends.
template <int M, class T, class Down, class Across>
inline void convolve_row(const SsimWindow<T>& w, int y, int rows, long stride, long width, T* columns, Down down,
                         Across across) {
  using P = typename PackLanes<T>::Value;
  constexpr int r = kSsimRadius;
  const long pitch = width + 2 * r;
  const int from = y < r ? -y : -r, to = y + r < rows ? r : rows - 1 - y;
  for (long x = 0; x < width; x += P::size) {
    P sums[M];
    for (P& s : sums) s = P(T(0));
    for (int k = from; k <= to; ++k) down((y + k) * stride + x, P(w.tap[k + r]), sums);
    for (int m = 0; m < M; ++m) sums[m].store(columns + m * pitch + r + x);
  }
  for (long x = 0; x < width; x += P::size) {
    P results[M];
    for (P& s : results) s = P(T(0));
    for (int k = 0; k <= 2 * r; ++k)
      for (int m = 0; m < M; ++m) results[m] += P(w.tap[k]) * P::load(columns + m * pitch + x + k);
    across(x, results);
  }
}

// Adds the gradient of weight * (1 - mean SSIM) / 2 to gradient_, returns the term. Image and target are both
// multiplied by the mask first, so what a dead pixel holds does not matter. The reverse of a convolution with
// a symmetric window is the convolution itself: five maps go forward (x, y, xx, yy, xy), three adjoints come back.
// Maps are in units of data_range: fourth powers of a line integral, whatever its unit, leave a float's range.
template <class T>
double CpuRenderer<T>::dssim_loss(const T* target, const T* mask, double weight, double data_range) {
  static const SsimWindow<T> window;
  const long width = (cols_ + P::size - 1) / P::size * P::size, pitch = width + 2 * kSsimRadius;
  const size_t pixels = static_cast<size_t>(rows_) * stride_;
  T* maps = maps_.reserve(5 * pixels);
  T *have = maps, *want = maps + pixels;  // masked, over the range, zero from column cols_ on
  T *v_mean = maps + 2 * pixels, *v_xx = maps + 3 * pixels, *v_xy = maps + 4 * pixels;  // adjoints
  const T unit = T(1 / data_range);
  const P c1(T(1e-4)), c2(T(9e-4));
  const P scale(T(-0.5 * weight / (static_cast<double>(rows_) * cols_))), zero(T(0)), two(T(2)), end{T(cols_)};
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int y = 0; y < rows_; ++y) {
    const T *image = line(image_, y), *aim = target + static_cast<size_t>(y) * cols_;
    const T* on = mask ? mask + static_cast<size_t>(y) * cols_ : nullptr;
    T *to = have + y * stride_, *other = want + y * stride_;
    for (int x = 0; x < cols_; ++x) to[x] = unit * (on ? on[x] * image[x] : image[x]);
    for (int x = 0; x < cols_; ++x) other[x] = unit * (on ? on[x] * aim[x] : aim[x]);
    for (long x = cols_; x < width; ++x) to[x] = other[x] = T(0);
  }
  double* partial = partial_.reserve(rows_);
#pragma omp parallel num_threads(threads_)
  {
    Buffer<T> scratch;
    T *columns = scratch.reserve(5 * pitch + width), *slope = columns + 5 * pitch;  // of a row
    memset(columns, 0, 5 * pitch * sizeof(T));
#pragma omp for schedule(static)
    for (int y = 0; y < rows_; ++y) {
      P sum(T(0));
      auto down = [&](long at, P tap, P* s) {
        const P a = P::load(have + at), b = P::load(want + at), ta = tap * a, tb = tap * b;
        s[0] += ta, s[1] += tb, s[2] += ta * a, s[3] += tb * b, s[4] += ta * b;
      };
      auto across = [&](long x, const P* m) {
        const P mx = m[0], my = m[1], cross = mx * my, square = mx * mx + my * my;
        const P a1 = two * cross + c1, a2 = two * (m[4] - cross) + c2;
        const P b1 = square + c1, b2 = m[2] + m[3] - square + c2;
        const P inverse = P(T(1)) / (b1 * b2), ssim = a1 * a2 * inverse;
        const typename P::Mask inside = L::index() + P(T(x)) < end;
        const long at = y * stride_ + x;
        select(inside, scale * two * a1 * inverse, zero).store(v_xy + at);
        select(inside, -scale * ssim * b1 * inverse, zero).store(v_xx + at);
        select(inside, scale * two * inverse * (my * (a2 - a1) + mx * ssim * (b1 - b2)), zero).store(v_mean + at);
        sum += select(inside, ssim, zero);
      };
      convolve_row<5>(window, y, rows_, stride_, width, columns, down, across);
      partial[y] = L::sum(sum);
    }
#pragma omp for schedule(static)
    for (int y = 0; y < rows_; ++y) {
      T* out = line(gradient_, y);
      auto down = [&](long at, P tap, P* s) {
        s[0] += tap * P::load(v_mean + at), s[1] += tap * P::load(v_xx + at), s[2] += tap * P::load(v_xy + at);
      };
      auto across = [&](long x, const P* m) {
        const long at = y * stride_ + x;
        (m[0] + two * P::load(have + at) * m[1] + P::load(want + at) * m[2]).store(slope + x);
      };
      convolve_row<3>(window, y, rows_, stride_, width, columns, down, across);
      const T* on = mask ? mask + static_cast<size_t>(y) * cols_ : nullptr;
      for (int x = 0; x < cols_; ++x) out[x] += unit * (on ? on[x] * slope[x] : slope[x]);
    }
  }
  double total = 0;
  for (int y = 0; y < rows_; ++y) total += partial[y];
  return weight * 0.5 * (1 - total / (static_cast<double>(rows_) * cols_));
}

}  // namespace SPLAT_NS
}  // namespace splat
