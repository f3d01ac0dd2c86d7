// Every entry point of the core, as plain pointers and sizes: the header to open first.
//
// All arrays are C-contiguous. T is float or double. Lengths in mm, attenuation in 1/mm, line integrals
// without unit. "Overwrites" and "accumulates" say what happens to outputs. Results are bit-identical
// for any number of threads: work is cut into fixed pieces whose sums are taken in a fixed order.
#pragma once

#include <cstdint>

namespace splat {

struct FrameIn {
  double first[3];   // source (cone) or unit ray direction (parallel)
  double center[3];  // detector centre, mm
  double u[3], v[3]; // one column, one row, mm
  bool cone;
};

template <class T>
struct SplatsIn {
  int64_t count;
  const T* means;    // [count, 3]
  const T* scales;   // [count, 3]
  const T* quats;    // [count, 4] w x y z, any length
  const T* density;  // [count]
};

template <class T>
struct SplatsOut {
  T* means;
  T* scales;
  T* quats;
  T* density;
};

struct GridIn {
  int nz, ny, nx;
  double voxel[3];   // z y x, mm
  double center[3];  // x y z, mm
};

// Residual statistics and normal equations of one view along 12 directions: the rigid motion of the object
// (omega rad, tau mm; world axes) and the six strains of the splats' means (xx, yy, zz, yz, xz, xy).
struct MotionNormal {
  double hessian[144];  // sum w dI dI'
  double gradient[12];  // sum w dI (I - target)
  double weighted_ss;   // sum w r^2
  double residual_ss;   // sum r^2
  double residual_abs;  // sum |r|
  double pixels;        // unmasked pixels
};

// Draws splats onto a rows x cols detector. One object holds the scratch memory of one detector size.
template <class T>
class Renderer {
 public:
  virtual ~Renderer() = default;
  // image [rows, cols]: overwrites.
  virtual void render(const FrameIn&, const SplatsIn<T>&, T* image) = 0;
  // Reverse of render for dL/dimage = v_image. Overwrites v; v_motion [6] (omega, tau) may be null.
  virtual void render_vjp(const FrameIn&, const SplatsIn<T>&, const T* v_image, const SplatsOut<T>& v,
                          double* v_motion) = 0;
  // (1 - dssim) mean huber(I - target) + dssim (1 - mean SSIM) / 2, and its gradient; huber(r) is
  // r^2 / (2 delta) up to |r| = delta, |r| - delta / 2 beyond.
  // mask [rows, cols], may be null: weights the pixels of the first term, multiplies image and target of the
  // second. data_range scales SSIM's constants. v_motion as in render_vjp; v_center [count, 2], may be null:
  // overwrites with dL/d(projected column, row) in 1/px. Returns the loss.
  virtual double loss_vjp(const FrameIn&, const SplatsIn<T>&, const T* target, const T* mask, double huber_delta,
                          double dssim, double data_range, const SplatsOut<T>& v, double* v_motion = nullptr,
                          T* v_center = nullptr) = 0;
  // Gauss-Newton sums of a view, without ever holding a whole derivative image.
  virtual MotionNormal motion_normal(const FrameIn&, const SplatsIn<T>&, const T* target, const T* mask,
                                     double huber_delta) = 0;
};

struct AdamRates {
  double mean, log_scale, quat, density;  // step sizes; mean in mm
  double scale_low, scale_high;           // mm
  double density_unit;                    // 1/mm; density = unit * softplus(raw)
  int step;                               // from 1
};

template <class T>
struct AdamState {
  int64_t count;
  T *means, *log_scales, *quats, *raw_density;  // updated
  T *first, *second;                            // [count, 11] moments, updated
  T *scales, *density;                          // activated parameters, overwritten
};

// The functions compiled for one instruction set.
template <class T>
struct Core {
  Renderer<T>* (*make_renderer)(int rows, int cols, int threads);  // the caller deletes it
  // volume [nz, ny, nx]: overwrites with the density at voxel centres.
  void (*voxelize)(const GridIn&, const SplatsIn<T>&, T* volume, int threads);
  void (*voxelize_vjp)(const GridIn&, const SplatsIn<T>&, const T* v_volume, const SplatsOut<T>& v, int threads);
  // Mean |difference| of neighbouring voxels along the three axes. Returns it, overwrites its gradient.
  double (*total_variation)(int nz, int ny, int nx, const T* volume, T* gradient, int threads);
  // One Adam step on raw parameters from gradients of activated ones.
  void (*adam)(const AdamState<T>&, const SplatsOut<T>& gradients, const AdamRates&, int threads);
  // Line integrals of a voxel volume: Joseph's method (bilinear in the slices across the ray's main axis).
  void (*project_volume)(const FrameIn&, const GridIn&, const T* volume, int rows, int cols, T* image, int threads);
  // Its exact adjoint; accumulates.
  void (*project_volume_adjoint)(const FrameIn&, const GridIn&, const T* image, int rows, int cols, T* volume,
                                 int threads);
  // FDK's last step: volume += weight * (depth at isocentre / depth at voxel)^2 * image at the voxel's shadow.
  void (*backproject)(const FrameIn&, const GridIn&, const T* image, int rows, int cols, double weight, T* volume,
                      int threads);
  // Independent multiply-adds on registers; returns how many were done (for bench/kernels).
  double (*peak_fma)(int64_t rounds, int threads);
};

// name: "avx512", "avx2", "plain" or nullptr for the best this processor has. Returns the name in use.
const char* choose_isa(const char* name);
template <class T>
const Core<T>& core();

}  // namespace splat
