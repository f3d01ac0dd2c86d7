// The Python face of api.hpp: shapes and types are checked here, the GIL is released, nothing else happens.
// Arrays come by DLPack or the buffer protocol from numpy and torch alike and are never copied.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>

#include "api.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace splat;

namespace {

template <class T>
using In1 = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T>
using In2 = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <class T>
using In3 = nb::ndarray<const T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
template <class T>
using Rows3 = nb::ndarray<const T, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
template <class T>
using Rows4 = nb::ndarray<const T, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out1 = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out2 = nb::ndarray<T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out3 = nb::ndarray<T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
template <class T>
using OutRows3 = nb::ndarray<T, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
template <class T>
using OutRows2 = nb::ndarray<T, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
template <class T>
using OutRows4 = nb::ndarray<T, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
// source (or ray), detector centre, u, v
using Frame = nb::ndarray<const double, nb::shape<4, 3>, nb::c_contig, nb::device::cpu>;
using Motion = nb::ndarray<double, nb::shape<6>, nb::c_contig, nb::device::cpu>;
template <class T>
using MaybeImage = std::optional<In2<T>>;

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument(message);
}

FrameIn frame_in(const Frame& f, bool cone) {
  FrameIn r;
  for (int i = 0; i < 3; ++i) {
    r.first[i] = f(0, i);
    r.center[i] = f(1, i);
    r.u[i] = f(2, i);
    r.v[i] = f(3, i);
  }
  r.cone = cone;
  return r;
}

// shape [nz, ny, nx], voxel [z, y, x] mm, centre [x, y, z] mm
using Grid = nb::ndarray<const double, nb::shape<2, 3>, nb::c_contig, nb::device::cpu>;
GridIn grid_in(size_t nz, size_t ny, size_t nx, const Grid& g) {
  GridIn r;
  r.nz = static_cast<int>(nz), r.ny = static_cast<int>(ny), r.nx = static_cast<int>(nx);
  for (int i = 0; i < 3; ++i) r.voxel[i] = g(0, i), r.center[i] = g(1, i);
  return r;
}

template <class T>
SplatsIn<T> splats_in(const Rows3<T>& means, const Rows3<T>& scales, const Rows4<T>& quats, const In1<T>& density) {
  const size_t n = means.shape(0);
  require(scales.shape(0) == n && quats.shape(0) == n && density.shape(0) == n,
          "means, scales, quats and density must be of the same number of splats");
  require(n > 0, "at least one splat is needed");
  require(n < (size_t(1) << 31), "more splats than a 32-bit index can name");
  return {static_cast<int64_t>(n), means.data(), scales.data(), quats.data(), density.data()};
}

template <class T>
SplatsOut<T> splats_out(int64_t count, const OutRows3<T>& means, const OutRows3<T>& scales, const OutRows4<T>& quats,
                        const Out1<T>& density) {
  const size_t n = static_cast<size_t>(count);
  require(means.shape(0) == n && scales.shape(0) == n && quats.shape(0) == n && density.shape(0) == n,
          "gradients must be of the same number of splats as the splats");
  return {means.data(), scales.data(), quats.data(), density.data()};
}

template <class T>
class Bound {
 public:
  Bound(int rows, int cols, int threads) : rows_(rows), cols_(cols) {
    require(rows > 0 && cols > 0 && threads > 0, "rows, cols and threads must be positive");
    renderer_.reset(core<T>().make_renderer(rows, cols, threads));
  }
  const T* image(const In2<T>& a) const {
    require(static_cast<int>(a.shape(0)) == rows_ && static_cast<int>(a.shape(1)) == cols_,
            "the image must be " + std::to_string(rows_) + " x " + std::to_string(cols_));
    return a.data();
  }
  const T* maybe(const MaybeImage<T>& a) const { return a ? image(*a) : nullptr; }
  Renderer<T>& operator*() { return *renderer_; }
  int rows_, cols_;

 private:
  std::unique_ptr<Renderer<T>> renderer_;
};

template <class T>
void bind(nb::module_& m, const char* renderer_name) {
  using R = Bound<T>;
  nb::class_<R>(m, renderer_name, "Draws splats onto one detector size, with the reverse of it; owns scratch memory.")
      .def(nb::init<int, int, int>(), "rows"_a, "cols"_a, "threads"_a)
      .def_ro("rows", &R::rows_)
      .def_ro("cols", &R::cols_)
      .def(
          "render",
          [](R& self, Frame frame, bool cone, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density, Out2<T> image) {
            const auto splats = splats_in<T>(means, scales, quats, density);
            self.image(In2<T>(image));
            const auto f = frame_in(frame, cone);
            nb::gil_scoped_release release;
            (*self).render(f, splats, image.data());
          },
          "frame"_a.noconvert(), "cone"_a, "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(),
          "density"_a.noconvert(), "image"_a.noconvert())
      .def(
          "render_vjp",
          [](R& self, Frame frame, bool cone, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density,
             In2<T> v_image, OutRows3<T> v_means, OutRows3<T> v_scales, OutRows4<T> v_quats, Out1<T> v_density, Motion v_motion) {
            const auto splats = splats_in<T>(means, scales, quats, density);
            const auto out = splats_out<T>(splats.count, v_means, v_scales, v_quats, v_density);
            const T* v = self.image(v_image);
            const auto f = frame_in(frame, cone);
            nb::gil_scoped_release release;
            (*self).render_vjp(f, splats, v, out, v_motion.data());
          },
          "frame"_a.noconvert(), "cone"_a, "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(),
          "density"_a.noconvert(), "v_image"_a.noconvert(), "v_means"_a.noconvert(), "v_scales"_a.noconvert(),
          "v_quats"_a.noconvert(), "v_density"_a.noconvert(), "v_motion"_a.noconvert())
      .def(
          "loss_vjp",
          [](R& self, Frame frame, bool cone, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density,
             In2<T> target, MaybeImage<T> mask, double huber_delta, double dssim, double data_range, OutRows3<T> v_means,
             OutRows3<T> v_scales, OutRows4<T> v_quats, Out1<T> v_density, std::optional<Motion> v_motion,
             std::optional<OutRows2<T>> v_center) {
            const auto splats = splats_in<T>(means, scales, quats, density);
            const auto out = splats_out<T>(splats.count, v_means, v_scales, v_quats, v_density);
            require(huber_delta > 0, "huber_delta must be positive");
            require(!v_center || v_center->shape(0) == means.shape(0), "v_center must be of the splats' number");
            const T *want = self.image(target), *on = self.maybe(mask);
            const auto f = frame_in(frame, cone);
            nb::gil_scoped_release release;
            return (*self).loss_vjp(f, splats, want, on, huber_delta, dssim, data_range, out,
                                    v_motion ? v_motion->data() : nullptr, v_center ? v_center->data() : nullptr);
          },
          "frame"_a.noconvert(), "cone"_a, "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(),
          "density"_a.noconvert(), "target"_a.noconvert(), "mask"_a.noconvert().none(), "huber_delta"_a, "dssim"_a,
          "data_range"_a, "v_means"_a.noconvert(), "v_scales"_a.noconvert(), "v_quats"_a.noconvert(),
          "v_density"_a.noconvert(), "v_motion"_a.noconvert().none() = nb::none(),
          "v_center"_a.noconvert().none() = nb::none())
      .def(
          "motion_normal",
          [](R& self, Frame frame, bool cone, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density,
             In2<T> target, MaybeImage<T> mask, double huber_delta, nb::ndarray<double, nb::shape<12, 12>, nb::c_contig, nb::device::cpu> hessian,
             nb::ndarray<double, nb::shape<12>, nb::c_contig, nb::device::cpu> gradient) {
            const auto splats = splats_in<T>(means, scales, quats, density);
            require(huber_delta > 0, "huber_delta must be positive");
            const T *want = self.image(target), *on = self.maybe(mask);
            const auto f = frame_in(frame, cone);
            MotionNormal n;
            {
              nb::gil_scoped_release release;
              n = (*self).motion_normal(f, splats, want, on, huber_delta);
            }
            for (int i = 0; i < 144; ++i) hessian.data()[i] = n.hessian[i];
            for (int i = 0; i < 12; ++i) gradient.data()[i] = n.gradient[i];
            return nb::make_tuple(n.weighted_ss, n.residual_ss, n.residual_abs, n.pixels);
          },
          "frame"_a.noconvert(), "cone"_a, "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(),
          "density"_a.noconvert(), "target"_a.noconvert(), "mask"_a.noconvert().none(), "huber_delta"_a,
          "hessian"_a.noconvert(), "gradient"_a.noconvert());

  m.def(
      "voxelize",
      [](Grid grid, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density, Out3<T> volume, int threads) {
        const auto splats = splats_in<T>(means, scales, quats, density);
        const auto g = grid_in(volume.shape(0), volume.shape(1), volume.shape(2), grid);
        nb::gil_scoped_release release;
        core<T>().voxelize(g, splats, volume.data(), threads);
      },
      "grid"_a.noconvert(), "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(), "density"_a.noconvert(),
      "volume"_a.noconvert(), "threads"_a);
  m.def(
      "voxelize_vjp",
      [](Grid grid, Rows3<T> means, Rows3<T> scales, Rows4<T> quats, In1<T> density, In3<T> v_volume, OutRows3<T> v_means,
         OutRows3<T> v_scales, OutRows4<T> v_quats, Out1<T> v_density, int threads) {
        const auto splats = splats_in<T>(means, scales, quats, density);
        const auto out = splats_out<T>(splats.count, v_means, v_scales, v_quats, v_density);
        const auto g = grid_in(v_volume.shape(0), v_volume.shape(1), v_volume.shape(2), grid);
        nb::gil_scoped_release release;
        core<T>().voxelize_vjp(g, splats, v_volume.data(), out, threads);
      },
      "grid"_a.noconvert(), "means"_a.noconvert(), "scales"_a.noconvert(), "quats"_a.noconvert(), "density"_a.noconvert(),
      "v_volume"_a.noconvert(), "v_means"_a.noconvert(), "v_scales"_a.noconvert(), "v_quats"_a.noconvert(),
      "v_density"_a.noconvert(), "threads"_a);
  m.def(
      "total_variation",
      [](In3<T> volume, Out3<T> gradient, int threads) {
        const int nz = static_cast<int>(volume.shape(0)), ny = static_cast<int>(volume.shape(1));
        const int nx = static_cast<int>(volume.shape(2));
        require(gradient.shape(0) == volume.shape(0) && gradient.shape(1) == volume.shape(1) &&
                    gradient.shape(2) == volume.shape(2),
                "gradient must have the shape of volume");
        nb::gil_scoped_release release;
        return core<T>().total_variation(nz, ny, nx, volume.data(), gradient.data(), threads);
      },
      "volume"_a.noconvert(), "gradient"_a.noconvert(), "threads"_a);
  m.def(
      "adam",
      [](OutRows3<T> means, OutRows3<T> log_scales, OutRows4<T> quats, Out1<T> raw_density, OutRows3<T> scales,
         Out1<T> density, Out1<T> first, Out1<T> second, Rows3<T> v_means, Rows3<T> v_scales, Rows4<T> v_quats,
         In1<T> v_density, double rate_mean, double rate_scale, double rate_quat, double rate_density, double scale_low,
         double scale_high, double density_unit, int step, int threads) {
        const size_t n = means.shape(0);
        require(log_scales.shape(0) == n && quats.shape(0) == n && raw_density.shape(0) == n && scales.shape(0) == n &&
                    density.shape(0) == n && first.shape(0) == 11 * n && second.shape(0) == 11 * n &&
                    v_means.shape(0) == n && v_scales.shape(0) == n && v_quats.shape(0) == n && v_density.shape(0) == n,
                "all arrays must be of the same number of splats, moments of 11 times as many");
        const AdamState<T> state{static_cast<int64_t>(n), means.data(), log_scales.data(), quats.data(), raw_density.data(),
                                 first.data(), second.data(), scales.data(), density.data()};
        // The gradients are only read; SplatsOut is the one record of four arrays.
        const SplatsOut<T> v{const_cast<T*>(v_means.data()), const_cast<T*>(v_scales.data()),
                             const_cast<T*>(v_quats.data()), const_cast<T*>(v_density.data())};
        const AdamRates rates{rate_mean, rate_scale, rate_quat, rate_density, scale_low, scale_high, density_unit, step};
        nb::gil_scoped_release release;
        core<T>().adam(state, v, rates, threads);
      },
      "means"_a.noconvert(), "log_scales"_a.noconvert(), "quats"_a.noconvert(), "raw_density"_a.noconvert(),
      "scales"_a.noconvert(), "density"_a.noconvert(), "first"_a.noconvert(), "second"_a.noconvert(),
      "v_means"_a.noconvert(), "v_scales"_a.noconvert(), "v_quats"_a.noconvert(), "v_density"_a.noconvert(),
      "rate_mean"_a, "rate_scale"_a, "rate_quat"_a, "rate_density"_a, "scale_low"_a, "scale_high"_a, "density_unit"_a,
      "step"_a, "threads"_a);
  m.def(
      "project_volume",
      [](Frame frame, bool cone, Grid grid, In3<T> volume, Out2<T> image, int threads) {
        const auto g = grid_in(volume.shape(0), volume.shape(1), volume.shape(2), grid);
        const auto f = frame_in(frame, cone);
        nb::gil_scoped_release release;
        core<T>().project_volume(f, g, volume.data(), static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)),
                                 image.data(), threads);
      },
      "frame"_a.noconvert(), "cone"_a, "grid"_a.noconvert(), "volume"_a.noconvert(), "image"_a.noconvert(), "threads"_a);
  m.def(
      "project_volume_adjoint",
      [](Frame frame, bool cone, Grid grid, In2<T> image, Out3<T> volume, int threads) {
        const auto g = grid_in(volume.shape(0), volume.shape(1), volume.shape(2), grid);
        const auto f = frame_in(frame, cone);
        nb::gil_scoped_release release;
        core<T>().project_volume_adjoint(f, g, image.data(), static_cast<int>(image.shape(0)),
                                         static_cast<int>(image.shape(1)), volume.data(), threads);
      },
      "frame"_a.noconvert(), "cone"_a, "grid"_a.noconvert(), "image"_a.noconvert(), "volume"_a.noconvert(), "threads"_a);
  m.def(
      "backproject",
      [](Frame frame, bool cone, Grid grid, In2<T> image, double weight, Out3<T> volume, int threads) {
        const auto g = grid_in(volume.shape(0), volume.shape(1), volume.shape(2), grid);
        const auto f = frame_in(frame, cone);
        nb::gil_scoped_release release;
        core<T>().backproject(f, g, image.data(), static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)), weight,
                              volume.data(), threads);
      },
      "frame"_a.noconvert(), "cone"_a, "grid"_a.noconvert(), "image"_a.noconvert(), "weight"_a, "volume"_a.noconvert(),
      "threads"_a);
}

}  // namespace

NB_MODULE(_native, m) {
  m.doc() = "SplatCT's core: Gaussian splats through X-ray geometry. See csrc/api.hpp.";
  bind<float>(m, "Renderer32");
  bind<double>(m, "Renderer64");
  m.def(
      "choose_isa",
      [](std::optional<std::string> name) {
        const char* chosen = choose_isa(name ? name->c_str() : nullptr);
        require(chosen != nullptr, "this processor or build has no '" + name.value_or("") + "'; known: avx512, avx2, plain");
        return std::string(chosen);
      },
      "name"_a.none() = nb::none(), "Use this instruction set from now on (renderers made before keep theirs); None: the best.");
  m.def(
      "peak_fma", [](int64_t rounds, int threads) {
        nb::gil_scoped_release release;
        return core<float>().peak_fma(rounds, threads);
      },
      "rounds"_a, "threads"_a, "Run independent float multiply-adds; returns how many were done.");
}
