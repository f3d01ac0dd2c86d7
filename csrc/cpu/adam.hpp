// Adam (Kingma & Ba 2015) on the raw parameters of all splats, with their activations, in one pass.
#pragma once

#include "api.hpp"
#include "math/pack.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
struct AdamTerms {
  T keep1, keep2, correct1, correct2;
  explicit AdamTerms(int step)
      : keep1(T(0.9)), keep2(T(0.999)), correct1(T(1 / (1 - pow(0.9, step)))),
        correct2(T(1 / (1 - pow(0.999, step)))) {}
  // The change of a parameter of gradient g and moments m, v, per unit of learning rate.
  SPLAT_HD T move(T g, T& m, T& v) const {
    m = keep1 * m + (T(1) - keep1) * g;
    v = keep2 * v + (T(1) - keep2) * g * g;
    return m * correct1 / (sqrt_of(v * correct2) + T(1e-15));
  }
};

template <class T>
void adam(const AdamState<T>& s, const SplatsOut<T>& g, const AdamRates& r, int threads) {
  const AdamTerms<T> terms(r.step);
  const T low = T(log(r.scale_low)), high = T(log(r.scale_high));
  const T mean = T(r.mean), log_scale = T(r.log_scale), quat = T(r.quat), density = T(r.density);
  const T unit = T(r.density_unit);
  const int64_t n = s.count, chunk = 2048;
  // Moments lie group by group: means [n,3], scales [n,3], quats [n,4], density [n].
  T *m1 = s.first, *v1 = s.second, *m2 = m1 + 3 * n, *v2 = v1 + 3 * n, *m3 = m1 + 6 * n, *v3 = v1 + 6 * n;
  T *m4 = m1 + 10 * n, *v4 = v1 + 10 * n;
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t from = 0; from < n; from += chunk) {
    const int64_t to = from + chunk < n ? from + chunk : n;
#pragma omp simd
    for (int64_t i = 3 * from; i < 3 * to; ++i) s.means[i] -= mean * terms.move(g.means[i], m1[i], v1[i]);
#pragma omp simd
    for (int64_t i = 4 * from; i < 4 * to; ++i) s.quats[i] -= quat * terms.move(g.quats[i], m3[i], v3[i]);
#pragma omp simd
    for (int64_t i = 3 * from; i < 3 * to; ++i) {
      const T raw = s.log_scales[i] - log_scale * terms.move(g.scales[i] * s.scales[i], m2[i], v2[i]);
      s.log_scales[i] = min_of(max_of(raw, low), high);
      s.scales[i] = exp_of(s.log_scales[i]);
    }
#pragma omp simd
    for (int64_t i = from; i < to; ++i) {
      // density = unit ln(1 + e^raw), so d density / d raw = unit (1 - e^(-density / unit))
      const T slope = unit * (T(1) - exp_of(-s.density[i] / unit));
      const T raw = s.raw_density[i] - density * terms.move(g.density[i] * slope, m4[i], v4[i]);
      s.raw_density[i] = raw;
      s.density[i] = unit * (max_of(raw, T(0)) + log1p_of(exp_of(-max_of(raw, -raw))));
    }
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
