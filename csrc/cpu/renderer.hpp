// Renderer on the CPU: project in packs, bin into bands of rows, walk.
//
// Forward and Gauss-Newton are parallel over bands of detector rows: every band is drawn by one thread into a woven
// image of its own that stays in cache, its splats in a fixed order, so sums do not depend on who draws what. Reverse
// is parallel over chunks of splats: each splat gathers its own six moments and nothing is shared.
#pragma once

#include "api.hpp"
#include "cpu/bins.hpp"
#include "cpu/buffer.hpp"
#include "cpu/load.hpp"
#include "cpu/woven.hpp"
#include "kernels/loss.hpp"
#include "kernels/stamp.hpp"

namespace splat {
inline namespace SPLAT_NS {

struct NormalSums;

inline constexpr int kAhead = 8;     // stamps
inline constexpr int kChunk = 512;   // splats a chunk; a multiple of every pack's size

// A pack of stamps as records [N].
template <class T, int N>
SPLAT_HD void store_stamps(const Stamp<Pack<T, N>>& s, Stamp<T>* records) {
  static_assert(sizeof(Stamp<T>) == kStampFields * sizeof(T) && kStampFields % N == 0);
  Pack<T, N> fields[kStampFields / N][N];
  memcpy(&fields, &s, sizeof fields);
  for (int part = 0; part < kStampFields / N; ++part) {
    transpose(fields[part]);
    for (int i = 0; i < N; ++i) fields[part][i].store(reinterpret_cast<T*>(records + i) + part * N);
  }
}

template <class T>
class CpuRenderer final : public Renderer<T> {
  using L = PackLanes<T>;
  using P = typename L::Value;

 public:
  // Rows of scratch images are padded so that a tile at any column lies inside, and so does a pack of them.
  CpuRenderer(int rows, int cols, int threads)
      : rows_(rows), cols_(cols), threads_(threads), stride_((cols + 15) / 16 * 16 + 16),
        bands_((rows + kBand - 1) / kBand) {
    const size_t pixels = static_cast<size_t>(bands_) * kBand * stride_;
    memset(image_.reserve(pixels), 0, pixels * sizeof(T));
    memset(gradient_.reserve(pixels), 0, pixels * sizeof(T));
    memset(woven_.reserve(pixels), 0, pixels * sizeof(T));
  }

  void render(const FrameIn& frame, const SplatsIn<T>& splats, T* image) override {
    draw(frame, splats, image, cols_);
  }

  void render_vjp(const FrameIn& frame, const SplatsIn<T>& splats, const T* v_image, const SplatsOut<T>& v,
                  double* v_motion) override {
    gather(frame, splats, v_image, cols_, v, v_motion, nullptr);
  }

  double loss_vjp(const FrameIn& frame, const SplatsIn<T>& splats, const T* target, const T* mask, double huber_delta,
                  double dssim, double data_range, const SplatsOut<T>& v, double* v_motion, T* v_center) override {
    draw(frame, splats, image_.data(), stride_);
    double loss = huber_loss(target, mask, T(huber_delta), 1 - dssim);
    if (dssim > 0) loss += dssim_loss(target, mask, dssim, data_range);
    gather(frame, splats, gradient_.data(), stride_, v, v_motion, v_center);
    return loss;
  }

  MotionNormal motion_normal(const FrameIn& frame, const SplatsIn<T>& splats, const T* target, const T* mask,
                             double huber_delta) override;

 private:
  T* line(Buffer<T>& image, int y) { return image.data() + static_cast<size_t>(y) * stride_; }

  // Projects all splats and sorts them into bands, by blocks of columns or not; stamps [count] may be null.
  void bin(const View<P>& view, const SplatsIn<T>& splats, bool by_blocks, Stamp<T>* stamps) {
    Place* places = bins_.places(splats.count);
#pragma omp parallel for num_threads(threads_) schedule(dynamic, kChunk / P::size)
    for (int64_t first = 0; first < splats.count; first += P::size) {
      const Projected<P> p = project(view, load_pack<P>(splats, first));
      const int n = splats.count - first < P::size ? static_cast<int>(splats.count - first) : P::size;
      alignas(64) Stamp<T> here[P::size];
      store_stamps(make_stamp<L>(p.foot, p.clearance, rows_, cols_), here);
      for (int i = 0; i < n; ++i) {
        const Stamp<T>& s = here[i];
        const auto band = [](auto y) { return static_cast<int16_t>(y / kBand); };
        const auto block = static_cast<int16_t>(s.x0 / kBlock);
        places[first + i] = shows(s) ? Place{band(s.y0), band(s.y1), block} : Place{0, -1, 0};
        if (stamps) stamps[first + i] = s;
      }
    }
    bins_.sort(splats.count, bands_, by_blocks ? cols_ / kBlock + 1 : 1, threads_);
  }

  struct Add {
    T* band;  // woven
    long stride;
    int top;
    P amplitude;
    SPLAT_HD void enter(P) {}
    SPLAT_HD void leave(P) {}
    SPLAT_HD void operator()(int x, int y, P, P, P e) {
      T* at = band + tile_at<L>(stride, x, y - top);
      (P::load(at) + amplitude * e).store(at);
    }
  };

  // image [rows, cols], rows `pitch` apart: overwrites.
  void draw(const FrameIn& frame, const SplatsIn<T>& splats, T* image, long pitch) {
    Stamp<T>* stamps = stamps_.reserve(splats.count);
    bin(widen<P>(make_view<T>(frame, rows_, cols_)), splats, false, stamps);
    const int32_t* order = bins_.order();
#pragma omp parallel num_threads(threads_)
    {
      Buffer<T> scratch;
      T* band = scratch.reserve(kBand * stride_);
#pragma omp for schedule(dynamic, 1)
      for (int b = 0; b < bands_; ++b) {
        const int top = b * kBand, bottom = top + kBand < rows_ ? top + kBand : rows_;
        memset(band, 0, kBand * stride_ * sizeof(T));
        const int64_t end = bins_.begin(b + 1);
        for (int64_t i = bins_.begin(b); i < end; ++i) {
          // A band's stamps lie scattered in memory; ask for them ahead of time.
          if (i + kAhead < end) __builtin_prefetch(stamps + order[i + kAhead]);
          const Stamp<T>& s = stamps[order[i]];
          Add add{band, stride_, top, P(s.amplitude)};
          walk<L>(s, top, bottom, add);
        }
        for (int y = top; y < bottom; ++y) unweave<L>(band, stride_, y - top, cols_, image + y * pitch);
      }
    }
  }

  struct ReadGradient {
    const T* image;  // woven
    long stride;
    SPLAT_HD P operator()(int x, int y) const { return P::load(image + tile_at<L>(stride, x, y)); }
  };

  // From dL/dimage [rows, cols], rows `pitch` apart, to dL/dsplats; v_motion [6] and v_center [count, 2] may be null.
  void gather(const FrameIn& frame, const SplatsIn<T>& splats, const T* v_image, long pitch, const SplatsOut<T>& v,
              double* v_motion, T* v_center) {
    T* woven = woven_.data();
    // Not `for (y += height)`: rows of a band, so that threads share no line of cache.
#pragma omp parallel for num_threads(threads_) schedule(static)
    for (int b = 0; b < bands_; ++b)
      for (int y = b * kBand; y < b * kBand + kBand && y < rows_; y += L::height)
        weave<L>(v_image, pitch, rows_, cols_, y, woven, stride_);
    const View<P> view = widen<P>(make_view<T>(frame, rows_, cols_));
    const int64_t chunks = (splats.count + kChunk - 1) / kChunk;
    double* partial = v_motion ? partial_.reserve(chunks * 6) : nullptr;
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      const int64_t end = chunk * kChunk + kChunk < splats.count ? chunk * kChunk + kChunk : splats.count;
      double sum[6] = {0, 0, 0, 0, 0, 0};
      for (int64_t first = chunk * kChunk; first < end; first += P::size) {
        const int n = end - first < P::size ? static_cast<int>(end - first) : P::size;
        const Gaussian<P> g = load_pack<P>(splats, first);
        const Projected<P> p = project(view, g);
        const Stamp<P> stamp = make_stamp<L>(p.foot, p.clearance, rows_, cols_);
        const Moments<P> m = moments(stamp, n, woven);
        GaussianGradient<P> d = project_vjp(view, g, p, m);
        const auto shown = stamp.x0 <= stamp.x1;
        store_pack<P>(v, first, n, d, shown);
        const P zero(T(0));
        if (v_center) {
          const P center[2] = {select(shown, d.column, zero), select(shown, d.row, zero)};
          store_records(center, v_center + 2 * first, n);
        }
        if (!v_motion) continue;
        const auto counted = shown & (L::index() < P(T(n)));  // past the end the last splat is repeated
        const P parts[6] = {d.torque.x, d.torque.y, d.torque.z, d.mean.x, d.mean.y, d.mean.z};
        for (int k = 0; k < 6; ++k) sum[k] += L::sum(select(counted, parts[k], zero));
      }
      for (int k = 0; v_motion && k < 6; ++k) partial[chunk * 6 + k] = sum[k];
    }
    if (!v_motion) return;
    for (int k = 0; k < 6; ++k) v_motion[k] = 0;
    for (int64_t chunk = 0; chunk < chunks; ++chunk)
      for (int k = 0; k < 6; ++k) v_motion[k] += partial[chunk * 6 + k];
  }

  // Of the first n splats of a pack.
  SPLAT_HD Moments<P> moments(const Stamp<P>& pack, int n, const T* woven) {
    alignas(64) Stamp<T> stamps[P::size];
    store_stamps(pack, stamps);
    P sums[6][P::size];  // [moment][splat], each over the lanes that walked
    for (int i = 0; i < P::size; ++i) {
      GatherMoments<L, T, ReadGradient> visit{{woven, stride_}};
      if (i < n) walk<L>(stamps[i], 0, rows_, visit);
      sums[0][i] = visit.one, sums[1][i] = visit.x, sums[2][i] = visit.y;
      sums[3][i] = visit.xx, sums[4][i] = visit.xy, sums[5][i] = visit.yy;
    }
    return {sums_of_each(sums[0]), sums_of_each(sums[1]), sums_of_each(sums[2]),
            sums_of_each(sums[3]), sums_of_each(sums[4]), sums_of_each(sums[5])};
  }

  // Overwrites gradient_ with the slope of the weighted Huber mean; returns the loss.
  double huber_loss(const T* target, const T* mask, T delta, double weight) {
    const T inverse = T(1) / delta, scale = T(weight / (static_cast<double>(rows_) * cols_));
    double* partial = partial_.reserve(rows_);
#pragma omp parallel for num_threads(threads_) schedule(static)
    for (int y = 0; y < rows_; ++y) {
      const size_t at = static_cast<size_t>(y) * cols_;
      const T *have = line(image_, y), *want = target + at;
      T* out = line(gradient_, y);
      auto row = [&](auto weight_of) {
        T sum(0);
#pragma omp simd reduction(+ : sum)
        for (int x = 0; x < cols_; ++x) {
          T value, slope;
          huber(have[x] - want[x], delta, inverse, value, slope);
          const T w = weight_of(x);
          sum += w * value;
          out[x] = scale * w * slope;
        }
        return sum;
      };
      partial[y] = mask ? row([on = mask + at](int x) { return on[x]; }) : row([](int) { return T(1); });
    }
    double total = 0;
    for (int y = 0; y < rows_; ++y) total += partial[y];
    return total * scale;
  }

  double dssim_loss(const T* target, const T* mask, double weight, double data_range);

  const int rows_, cols_, threads_;
  const long stride_;
  const int bands_;
  Buffer<T> image_, gradient_;  // plain, of loss_vjp
  Buffer<T> woven_;             // dL/dimage as the reverse reads it
  Buffer<T> maps_;              // of dssim_loss
  Buffer<Stamp<T>> stamps_;
  Bins bins_;
  Buffer<NormalSums> normals_;  // of motion_normal, by band
  Buffer<double> partial_;
};

}  // namespace SPLAT_NS
}  // namespace splat

#include "cpu/dssim.hpp"
#include "cpu/motion.hpp"
