// Gauss-Newton sums of one view, band by band.
//
// Thirteen images are drawn at once, the value and its derivatives along twelve directions. Here the lanes of a
// register are the images, not the pixels: a pixel is one record of sixteen numbers, a line of cache, and each splat
// adds value * (a quadratic in dx, dy with coefficients by lane) to it. No lane idles at the edge of a footprint, and
// every line that is touched is used. A band's records stay in cache (its splats come from left to right), the 12x12
// sums are taken, and the band is forgotten. Projection is done again for every band that a splat shows in, sixteen
// splats at a time, which costs less than the memory traffic of keeping 72 coefficients a splat.
#pragma once

#include "cpu/renderer.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kImages = 1 + kDirections;  // the value, later the residual, and its derivatives
inline constexpr int kRecord = 16;               // numbers a pixel: images and padding
inline constexpr int kTerms = 6;                 // 1, dx, dy, dx^2, dx dy, dy^2

// What a band needs of a pack of splats: stamps, and the coefficients of each as [term][image].
template <class T>
struct MotionPack {
  using L = PackLanes<T>;
  using P = typename L::Value;
  alignas(64) Stamp<T> stamps[P::size];
  alignas(64) T coefficients[P::size][kTerms][kRecord];

  void make(const View<P>& view, const Gaussian<P>& g, int rows, int cols) {
    const Projected<P> p = project(view, g);
    store_stamps(make_stamp<L>(p.foot, p.clearance, rows, cols), stamps);
    Moments<P> d[kDirections];
    motion_derivatives(view, g, p, d);
    const P Moments<P>::* const terms[kTerms] = {&Moments<P>::one, &Moments<P>::x,  &Moments<P>::y,
                                                 &Moments<P>::xx,  &Moments<P>::xy, &Moments<P>::yy};
    for (int t = 0; t < kTerms; ++t) {
      P images[kRecord / P::size][P::size];
      for (int k = 0; k < kRecord; ++k) {
        const bool derivative = k >= 1 && k < kImages;
        images[k / P::size][k % P::size] = derivative ? d[k - 1].*terms[t] : P(T(k == 0 && t == 0));
      }
      for (int part = 0; part < kRecord / P::size; ++part) {
        transpose(images[part]);
        for (int i = 0; i < P::size; ++i) images[part][i].store(coefficients[i][t] + part * P::size);
      }
    }
  }
};

// Adds a splat to the records of a band.
template <class T>
struct AddMotion {
  using L = PackLanes<T>;
  using P = typename L::Value;
  static constexpr int parts = kRecord / P::size;
  T* band;  // [rows, stride, kRecord]
  long stride;
  int top, x1;
  P amplitude;
  const T (*c)[kRecord];  // [kTerms]
  T across[L::count];     // dx of the present columns, by lane
  SPLAT_HD void enter(P dx) { dx.store(across); }
  SPLAT_HD void leave(P) {}
  SPLAT_HD void operator()(int x, int y, P, P dy, P e) {
    T value[L::count], down[L::count];
    (amplitude * e).store(value);
    dy.store(down);
    const int n = x1 - x < L::width ? x1 - x + 1 : L::width;
    for (int r = 0; r < L::height; ++r) {
      const P v(down[r]);
      P flat[parts], lean[parts], bend[parts];  // along the row: flat + lean dx + bend dx^2
      for (int p = 0; p < parts; ++p) {
        auto term = [&](int t) { return P::load(c[t] + p * P::size); };
        flat[p] = term(0) + v * (term(2) + v * term(5));
        lean[p] = term(1) + v * term(4);
        bend[p] = term(3);
      }
      T* record = band + ((y - top + r) * stride + x) * kRecord;
      for (int i = 0; i < n; ++i, record += kRecord) {
        const P u(across[i * L::height]), here(value[i * L::height + r]);
        for (int p = 0; p < parts; ++p) {
          const P d = flat[p] + u * (lean[p] + u * bend[p]);
          (P::load(record + p * P::size) + here * d).store(record + p * P::size);
        }
      }
    }
  }
};

// What one band, or the whole view, adds up to.
struct NormalSums {
  double products[kImages][kRecord];  // <image k, image l>, weighted; of l < k only those in k's register and beyond
  double squares, sizes, pixels;
};

// Lanes part * size .. of the products: acc[k] += u_k (w u) for the images k from the first of these lanes on; the
// others are known by symmetry.
template <int part, class T>
inline void add_products(const T* records, const T* weight, int cols, NormalSums& sums) {
  using P = typename PackLanes<T>::Value;
  constexpr int first = part * P::size;
  if constexpr (first < kImages) {
    P acc[kImages - first];
    for (P& a : acc) a = P(T(0));
    for (int x = 0; x < cols; ++x) {
      const T* u = records + static_cast<long>(x) * kRecord;
      const P weighted = P(weight[x]) * P::load(u + first);
      for (int k = first; k < kImages; ++k) acc[k - first] += P(u[k]) * weighted;
    }
    for (int k = first; k < kImages; ++k)
      for (int l = 0; l < P::size; ++l) sums.products[k][first + l] += acc[k - first].v[l];
    add_products<part + 1>(records, weight, cols, sums);
  }
}

// Sums one row of a band, whose values it makes residuals. The weight is slope(r) / r of the Huber loss times the
// mask. weight [cols]: scratch.
template <class T>
inline void add_normal_row(T* records, const T* target, const T* mask, int cols, T delta, T* weight,
                           NormalSums& sums) {
  T squares(0), sizes(0), pixels(0);
#pragma omp simd reduction(+ : squares, sizes, pixels)
  for (int x = 0; x < cols; ++x) {
    const T on = mask ? mask[x] : T(1), r = records[static_cast<long>(x) * kRecord] - target[x];
    const T size = r < T(0) ? -r : r;
    records[static_cast<long>(x) * kRecord] = r;
    squares += on * r * r;
    sizes += on * size;
    pixels += on;
    weight[x] = on * (size > delta ? delta / size : T(1));
  }
  sums.squares += squares, sums.sizes += sizes, sums.pixels += pixels;
  add_products<0>(records, weight, cols, sums);
}

template <class T>
MotionNormal CpuRenderer<T>::motion_normal(const FrameIn& frame, const SplatsIn<T>& splats, const T* target,
                                           const T* mask, double huber_delta) {
  const View<P> view = widen<P>(make_view<T>(frame, rows_, cols_));
  bin(view, splats, true, nullptr);
  const int32_t* order = bins_.order();
  NormalSums* partial = normals_.reserve(bands_);
#pragma omp parallel num_threads(threads_)
  {
    Buffer<T> records, weights;
    T* band = records.reserve(kBand * stride_ * kRecord);
    T* weight = weights.reserve(cols_);
    MotionPack<T> pack;
#pragma omp for schedule(dynamic, 1)
    for (int b = 0; b < bands_; ++b) {
      const int top = b * kBand, bottom = top + kBand < rows_ ? top + kBand : rows_;
      memset(band, 0, kBand * stride_ * kRecord * sizeof(T));
      const int64_t end = bins_.begin(b + 1);
      for (int64_t i = bins_.begin(b); i < end; i += P::size) {
        const int n = end - i < P::size ? static_cast<int>(end - i) : P::size;
        pack.make(view, load_each<P>(splats, [&](int k) { return order[k < n ? i + k : end - 1]; }), rows_, cols_);
        for (int k = 0; k < n; ++k) {
          const Stamp<T>& s = pack.stamps[k];
          AddMotion<T> add{band, stride_, top, static_cast<int>(s.x1), P(s.amplitude), pack.coefficients[k], {}};
          walk<L>(s, top, bottom, add);
        }
      }
      memset(partial + b, 0, sizeof(NormalSums));
      for (int y = top; y < bottom; ++y) {
        const size_t at = static_cast<size_t>(y) * cols_;
        add_normal_row(band + (y - top) * stride_ * kRecord, target + at, mask ? mask + at : nullptr, cols_,
                       T(huber_delta), weight, partial[b]);
      }
    }
  }
  NormalSums sums;
  memset(&sums, 0, sizeof sums);
  for (int b = 0; b < bands_; ++b) {
    for (int k = 0; k < kImages; ++k)
      for (int l = 0; l < kRecord; ++l) sums.products[k][l] += partial[b].products[k][l];
    sums.squares += partial[b].squares, sums.sizes += partial[b].sizes, sums.pixels += partial[b].pixels;
  }
  MotionNormal normal;
  for (int k = 0; k < kDirections; ++k) {
    normal.gradient[k] = sums.products[k + 1][0];
    for (int l = 0; l <= k; ++l)
      normal.hessian[kDirections * k + l] = normal.hessian[kDirections * l + k] = sums.products[k + 1][l + 1];
  }
  normal.weighted_ss = sums.products[0][0];
  normal.residual_ss = sums.squares;
  normal.residual_abs = sums.sizes;
  normal.pixels = sums.pixels;
  return normal;
}

}  // namespace SPLAT_NS
}  // namespace splat
