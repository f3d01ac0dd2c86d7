// Renderer on the CPU: project in packs, bin into bands of rows, walk.
//
// Forward and Gauss-Newton are parallel over bands of detector rows: every band is drawn by one thread, its
// splats in index order, so sums do not depend on who draws what. Reverse is parallel over chunks of
// splats: each splat gathers its own six moments and nothing is shared.
#pragma once

#include "api.hpp"
#include "cpu/buffer.hpp"
#include "cpu/load.hpp"
#include "kernels/loss.hpp"
#include "kernels/stamp.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kBand = 16;     // rows a band
inline constexpr int kAhead = 8;     // stamps
inline constexpr int kChunk = 512;   // splats a chunk; a multiple of every pack's size
inline constexpr int kMotion = 6 * kDirections;  // six polynomial coefficients for each direction

template <class T>
class CpuRenderer final : public Renderer<T> {
  using L = PackLanes<T>;
  using P = typename L::Value;

 public:
  CpuRenderer(int rows, int cols, int threads)
      : rows_(rows), cols_(cols), threads_(threads), stride_((cols + 15) / 16 * 16 + 16),
        bands_((rows + kBand - 1) / kBand) {
    const size_t pixels = static_cast<size_t>(rows_) * stride_;
    memset(image_.reserve(pixels), 0, pixels * sizeof(T));
    memset(gradient_.reserve(pixels), 0, pixels * sizeof(T));
  }

  void render(const FrameIn& frame, const SplatsIn<T>& splats, T* image) override {
    draw(frame, splats);
    for (int y = 0; y < rows_; ++y) memcpy(image + static_cast<size_t>(y) * cols_, line(image_, y), cols_ * sizeof(T));
  }

  void render_vjp(const FrameIn& frame, const SplatsIn<T>& splats, const T* v_image, const SplatsOut<T>& v,
                  double* v_motion) override {
    for (int y = 0; y < rows_; ++y)
      memcpy(line(gradient_, y), v_image + static_cast<size_t>(y) * cols_, cols_ * sizeof(T));
    stamp(frame, splats, false);
    gather(frame, splats, v, v_motion);
  }

  double loss_vjp(const FrameIn& frame, const SplatsIn<T>& splats, const T* target, const T* mask, double huber_delta,
                  double dssim, double data_range, const SplatsOut<T>& v, double* v_motion) override {
    draw(frame, splats);
    double loss = huber_loss(target, mask, T(huber_delta), 1 - dssim);
    if (dssim > 0) loss += dssim_loss(target, mask, dssim, data_range);
    gather(frame, splats, v, v_motion);
    return loss;
  }

  MotionNormal motion_normal(const FrameIn& frame, const SplatsIn<T>& splats, const T* target, const T* mask,
                             double huber_delta) override;

 private:
  T* line(Buffer<T>& image, int y) { return image.data() + static_cast<size_t>(y) * stride_; }

  // Projects all splats: stamps_, and with `motion` the polynomial coefficients of motion_derivative.
  void stamp(const FrameIn& frame, const SplatsIn<T>& splats, bool motion) {
    const View<P> view = widen<P>(make_view<T>(frame, rows_, cols_));
    Stamp<T>* stamps = stamps_.reserve(splats.count);
    T* coefficients = motion ? motion_.reserve(splats.count * kMotion) : nullptr;
    const int64_t chunks = (splats.count + kChunk - 1) / kChunk;
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      const int64_t end = chunk * kChunk + kChunk < splats.count ? chunk * kChunk + kChunk : splats.count;
      for (int64_t first = chunk * kChunk; first < end; first += P::size) {
        const Gaussian<P> g = load_pack<P>(splats, first);
        const Projected<P> p = project(view, g);
        const int n = end - first < P::size ? static_cast<int>(end - first) : P::size;
        for (int i = 0; i < n; ++i) {
          const Footprint<T> f{p.foot.column.v[i], p.foot.row.v[i], p.foot.a.v[i], p.foot.b.v[i], p.foot.c.v[i],
                               p.foot.amplitude.v[i]};
          stamps[first + i] = make_stamp(f, p.clearance.v[i], rows_, cols_);
        }
        if (!motion) continue;
        for (int k = 0; k < kDirections; ++k) {
          const Moments<P> d = motion_derivative(view, g, p, k);
          for (int i = 0; i < n; ++i) {
            T* c = coefficients + (first + i) * kMotion + 6 * k;
            c[0] = d.one.v[i], c[1] = d.x.v[i], c[2] = d.y.v[i], c[3] = d.xx.v[i], c[4] = d.xy.v[i], c[5] = d.yy.v[i];
          }
        }
      }
    }
  }

  // Counting sort of the stamps into bands, in index order.
  void bin(int64_t count) {
    int64_t* start = band_start_.reserve(bands_ + 1);
    const Stamp<T>* stamps = stamps_.data();
    for (int b = 0; b <= bands_; ++b) start[b] = 0;
    for (int64_t i = 0; i < count; ++i)
      if (stamps[i].x0 <= stamps[i].x1)
        for (int b = stamps[i].y0 / kBand; b <= stamps[i].y1 / kBand; ++b) ++start[b + 1];
    for (int b = 0; b < bands_; ++b) start[b + 1] += start[b];
    int32_t* order = band_order_.reserve(start[bands_]);
    int64_t* next = band_next_.reserve(bands_);
    for (int b = 0; b < bands_; ++b) next[b] = start[b];
    for (int64_t i = 0; i < count; ++i)
      if (stamps[i].x0 <= stamps[i].x1)
        for (int b = stamps[i].y0 / kBand; b <= stamps[i].y1 / kBand; ++b) order[next[b]++] = static_cast<int32_t>(i);
  }

  struct Add {
    T* image;
    long stride;
    P amplitude;
    SPLAT_HD void enter(P) {}
    SPLAT_HD void leave(P) {}
    SPLAT_HD void operator()(int x, int y, P, T, P e) {
      T* at = image + y * stride + x;
      (P::load(at) + amplitude * e).store(at);
    }
  };

  void draw(const FrameIn& frame, const SplatsIn<T>& splats) {
    stamp(frame, splats, false);
    bin(splats.count);
    const Stamp<T>* stamps = stamps_.data();
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
    for (int b = 0; b < bands_; ++b) {
      const int top = b * kBand, bottom = top + kBand < rows_ ? top + kBand : rows_;
      memset(line(image_, top), 0, static_cast<size_t>(bottom - top) * stride_ * sizeof(T));
      const int64_t end = band_start_[b + 1];
      for (int64_t i = band_start_[b]; i < end; ++i) {
        // A band's stamps lie scattered in memory; ask for them ahead of time.
        if (i + kAhead < end) __builtin_prefetch(stamps + band_order_[i + kAhead]);
        const Stamp<T>& s = stamps[band_order_[i]];
        Add add{image_.data(), stride_, P(s.amplitude)};
        walk<L>(s, top, bottom, add);
      }
    }
  }

  struct ReadGradient {
    const T* image;
    long stride;
    SPLAT_HD P operator()(int x, int y) const { return P::load(image + y * stride + x); }
  };

  // From gradient_ (dL/dimage, zero in the padding) to dL/dsplats. Needs stamps_ of this frame.
  void gather(const FrameIn& frame, const SplatsIn<T>& splats, const SplatsOut<T>& v, double* v_motion) {
    const View<P> view = widen<P>(make_view<T>(frame, rows_, cols_));
    const int64_t chunks = (splats.count + kChunk - 1) / kChunk;
    double* partial = v_motion ? partial_.reserve(chunks * 6) : nullptr;
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      const int64_t end = chunk * kChunk + kChunk < splats.count ? chunk * kChunk + kChunk : splats.count;
      double sum[6] = {0, 0, 0, 0, 0, 0};
      for (int64_t first = chunk * kChunk; first < end; first += P::size) {
        const int n = end - first < P::size ? static_cast<int>(end - first) : P::size;
        Moments<P> m{P(T(0)), P(T(0)), P(T(0)), P(T(0)), P(T(0)), P(T(0))};
        bool any = false;
        for (int i = 0; i < n; ++i) {
          const Stamp<T>& s = stamps_[first + i];
          if (s.x0 > s.x1) continue;
          any = true;
          GatherMoments<L, T, ReadGradient> visit{{gradient_.data(), stride_}};
          walk<L>(s, 0, rows_, visit);
          const Moments<T> total = visit.total();
          m.one.v[i] = total.one, m.x.v[i] = total.x, m.y.v[i] = total.y;
          m.xx.v[i] = total.xx, m.xy.v[i] = total.xy, m.yy.v[i] = total.yy;
        }
        if (!any) {
          const P zero(T(0)), three[3] = {zero, zero, zero}, four[4] = {zero, zero, zero, zero};
          store_pack<P>(v, first, end, {zero, zero, zero}, three, four, zero);
          continue;
        }
        const Gaussian<P> g = load_pack<P>(splats, first);
        GaussianGradient<P> d = project_vjp(view, g, project(view, g), m);
        for (int i = 0; i < n; ++i)
          if (stamps_[first + i].x0 > stamps_[first + i].x1) clear_lane(d, i);
        store_pack<P>(v, first, end, d.mean, d.scale, d.quat, d.density);
        for (int i = 0; v_motion && i < n; ++i) {
          const T part[6] = {d.torque.x.v[i], d.torque.y.v[i], d.torque.z.v[i],
                             d.mean.x.v[i],   d.mean.y.v[i],   d.mean.z.v[i]};
          for (int k = 0; k < 6; ++k) sum[k] += part[k];
        }
      }
      for (int k = 0; v_motion && k < 6; ++k) partial[chunk * 6 + k] = sum[k];
    }
    if (!v_motion) return;
    for (int k = 0; k < 6; ++k) v_motion[k] = 0;
    for (int64_t chunk = 0; chunk < chunks; ++chunk)
      for (int k = 0; k < 6; ++k) v_motion[k] += partial[chunk * 6 + k];
  }

  // Overwrites gradient_ with the slope of the weighted Huber mean; returns the loss.
  double huber_loss(const T* target, const T* mask, T delta, double weight) {
    const T inverse = T(1) / delta, scale = T(weight / (static_cast<double>(rows_) * cols_));
    double* partial = partial_.reserve(rows_);
#pragma omp parallel for num_threads(threads_) schedule(static)
    for (int y = 0; y < rows_; ++y) {
      const T *have = line(image_, y), *want = target + static_cast<size_t>(y) * cols_;
      T* out = line(gradient_, y);
      T sum(0);
#pragma omp simd reduction(+ : sum)
      for (int x = 0; x < cols_; ++x) {
        T value, slope;
        huber(have[x] - want[x], delta, inverse, value, slope);
        sum += value;
        out[x] = scale * slope;
      }
      if (mask) {
        sum = 0;
        for (int x = 0; x < cols_; ++x) {
          const T w = mask[static_cast<size_t>(y) * cols_ + x];
          T value, slope;
          huber(have[x] - want[x], delta, inverse, value, slope);
          sum += w * value;
          out[x] *= w;
        }
      }
      partial[y] = sum;
    }
    double total = 0;
    for (int y = 0; y < rows_; ++y) total += partial[y];
    return total * scale;
  }

  double dssim_loss(const T* target, const T* mask, double weight, double data_range);

  const int rows_, cols_, threads_;
  const long stride_;
  const int bands_;
  Buffer<T> image_, gradient_, motion_, maps_;
  Buffer<Stamp<T>> stamps_;
  Buffer<int64_t> band_start_, band_next_;
  Buffer<int32_t> band_order_;
  Buffer<double> partial_;
};

}  // namespace SPLAT_NS
}  // namespace splat

#include "cpu/dssim.hpp"
#include "cpu/motion.hpp"
