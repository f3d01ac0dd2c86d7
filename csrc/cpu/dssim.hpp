// The D-SSIM term of the loss and its gradient (Wang et al. 2004; window of 11 px, zero padding).
#pragma once

#include "cpu/renderer.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Adds the gradient of weight * (1 - mean SSIM) / 2 to gradient_, returns the term. The reverse of a
// convolution with a symmetric window is the convolution itself, so five maps go forward, three back.
template <class T>
double CpuRenderer<T>::dssim_loss(const T* target, double weight, double data_range) {
  static const SsimWindow<T> window;
  const size_t pixels = static_cast<size_t>(rows_) * cols_;
  T* maps = maps_.reserve(8 * pixels);
  T *xx = maps, *yy = maps + pixels, *xy = maps + 2 * pixels;                                  // products
  T *v_mean = maps + 3 * pixels, *v_xx = maps + 4 * pixels, *v_xy = maps + 5 * pixels;         // adjoints
  T* x_image = maps + 6 * pixels;
  const T c1 = T(1e-4 * data_range * data_range), c2 = T(9e-4 * data_range * data_range);
  const T scale = T(-0.5 * weight / static_cast<double>(pixels));
#pragma omp parallel for num_threads(threads_) schedule(static)
  for (int y = 0; y < rows_; ++y) {
    const T* have = line(image_, y);
    const size_t at = static_cast<size_t>(y) * cols_;
    for (int x = 0; x < cols_; ++x) {
      x_image[at + x] = have[x];
      xx[at + x] = have[x] * have[x];
      yy[at + x] = target[at + x] * target[at + x];
      xy[at + x] = have[x] * target[at + x];
    }
  }
  double* partial = partial_.reserve(rows_);
#pragma omp parallel num_threads(threads_)
  {
    Buffer<T> scratch;
    T* row = scratch.reserve(6 * (cols_ + 2 * kSsimRadius));
    T *mx = row + cols_ + 2 * kSsimRadius, *my = mx + cols_, *exx = my + cols_, *eyy = exx + cols_, *exy = eyy + cols_;
#pragma omp for schedule(static)
    for (int y = 0; y < rows_; ++y) {
      convolve_row(window, x_image, rows_, cols_, cols_, y, row, mx);
      convolve_row(window, target, rows_, cols_, cols_, y, row, my);
      convolve_row(window, xx, rows_, cols_, cols_, y, row, exx);
      convolve_row(window, yy, rows_, cols_, cols_, y, row, eyy);
      convolve_row(window, xy, rows_, cols_, cols_, y, row, exy);
      const size_t at = static_cast<size_t>(y) * cols_;
      double sum = 0;
      for (int x = 0; x < cols_; ++x) {
        const T a1 = 2 * mx[x] * my[x] + c1, a2 = 2 * (exy[x] - mx[x] * my[x]) + c2;
        const T b1 = mx[x] * mx[x] + my[x] * my[x] + c1;
        const T b2 = exx[x] - mx[x] * mx[x] + eyy[x] - my[x] * my[x] + c2;
        const T inverse = 1 / (b1 * b2), ssim = a1 * a2 * inverse;
        v_xy[at + x] = scale * 2 * a1 * inverse;
        v_xx[at + x] = -scale * ssim / b2;
        v_mean[at + x] = scale * (2 * my[x] * (a2 - a1) * inverse + 2 * mx[x] * ssim * (1 / b2 - 1 / b1));
        sum += ssim;
      }
      partial[y] = sum;
    }
#pragma omp for schedule(static)
    for (int y = 0; y < rows_; ++y) {
      convolve_row(window, v_mean, rows_, cols_, cols_, y, row, mx);
      convolve_row(window, v_xx, rows_, cols_, cols_, y, row, exx);
      convolve_row(window, v_xy, rows_, cols_, cols_, y, row, exy);
      const T *have = line(image_, y), *want = target + static_cast<size_t>(y) * cols_;
      T* out = line(gradient_, y);
      for (int x = 0; x < cols_; ++x) out[x] += mx[x] + 2 * have[x] * exx[x] + want[x] * exy[x];
    }
  }
  double total = 0;
  for (int y = 0; y < rows_; ++y) total += partial[y];
  return weight * 0.5 * (1 - total / static_cast<double>(pixels));
}

}  // namespace SPLAT_NS
}  // namespace splat
