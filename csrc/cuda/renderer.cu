// Kernels on CUDA: shells around the templates that the CPU runs (math/, kernels/stamp.hpp, kernels/blob.hpp).
//
// Projection and its reverse: one thread per splat. Walks over pixels or voxels: `kLanes` threads of a warp per splat,
// as footprints are about eight pixels wide. Forward adds integers, backward gathers: both are deterministic.
#include "cuda/load.cuh"
#include "cuda/renderer.hpp"
#include "kernels/blob.hpp"
#include "math/view.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kLanes = 8;      // threads a splat
inline constexpr int kThreads = 128;  // threads a block
inline constexpr int kBlocks = 3;     // blocks a multiprocessor at least: up to 168 registers a thread

template <class T>
using Lanes = WarpLanes<T, kLanes>;

__device__ __forceinline__ int64_t thread_index() {
  return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
}
inline unsigned blocks_for(int64_t threads) { return static_cast<unsigned>((threads + kThreads - 1) / kThreads); }

// ---- the detector ----------------------------------------------------------------------------------

template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
stamp_kernel(View<T> view, SplatsIn<T> splats, int rows, int cols, Stamp<T>* stamps) {
  const int64_t n = thread_index();
  if (n >= splats.count) return;
  const Projected<T> p = project(view, load_one(splats, n));
  stamps[n] = make_stamp<Lanes<T>>(p.foot, p.clearance, rows, cols);
}

template <class T>
struct AddPixels {
  unsigned long long* sums;
  int cols;
  T amplitude;
  __device__ void enter(T) {}
  __device__ void leave(T) {}
  __device__ void operator()(int x, int y, T, T, T e) {
    const int column = x + (threadIdx.x & (kLanes - 1));
    if (column < cols) add_exactly(sums + static_cast<int64_t>(y) * cols + column, amplitude * e);
  }
};

template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
forward_kernel(const Stamp<T>* stamps, int64_t count, int rows, int cols, unsigned long long* sums) {
  const int64_t n = thread_index() / kLanes;
  if (n >= count) return;
  const Stamp<T> s = stamps[n];
  AddPixels<T> add{sums, cols, s.amplitude};
  walk<Lanes<T>>(s, 0, rows, add);
}

template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
from_units_kernel(const unsigned long long* sums, int64_t count, T* out) {
  const int64_t n = thread_index();
  if (n < count) out[n] = from_units<T>(sums[n]);
}

template <class T>
struct ReadPixels {
  const T* image;
  int cols;
  __device__ T operator()(int x, int y) const {
    const int column = x + (threadIdx.x & (kLanes - 1));
    return column < cols ? image[static_cast<int64_t>(y) * cols + column] : T(0);
  }
};

// moments [count]: overwrites.
template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
gather_kernel(const Stamp<T>* stamps, int64_t count, int rows, int cols, const T* v_image, Moments<T>* moments) {
  const int64_t n = thread_index() / kLanes;
  Stamp<T> s = stamps[n < count ? n : count - 1];
  if (n >= count) s.x1 = s.x0 - 1;  // stays for the sums over lanes, which need the whole warp
  GatherMoments<Lanes<T>, T, ReadPixels<T>> gather{{v_image, cols}};
  walk<Lanes<T>>(s, 0, rows, gather);
  using L = Lanes<T>;
  const Moments<T> m{L::sum(gather.one), L::sum(gather.x),  L::sum(gather.y),
                     L::sum(gather.xx),  L::sum(gather.xy), L::sum(gather.yy)};
  if (n < count && (threadIdx.x & (kLanes - 1)) == 0) moments[n] = m;
}

// From moments to gradients. partial [blocks, 6]: the block's sum of dL/d(omega, tau), in a fixed tree.
template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
reverse_kernel(View<T> view, SplatsIn<T> splats, const Stamp<T>* stamps, const Moments<T>* moments, SplatsOut<T> v,
               double* partial) {
  const int64_t n = thread_index();
  GaussianGradient<T> d = no_gradient<T>();
  if (n < splats.count) {
    if (shows(stamps[n])) {
      const Gaussian<T> g = load_one(splats, n);
      d = project_vjp(view, g, project(view, g), moments[n]);
    }
    store_one(v, n, d);
  }
  __shared__ double sums[kThreads];
  const double part[6] = {d.torque.x, d.torque.y, d.torque.z, d.mean.x, d.mean.y, d.mean.z};
  for (int k = 0; k < 6; ++k) {
    sums[threadIdx.x] = part[k];
    for (int half = kThreads / 2; half > 0; half /= 2) {
      __syncthreads();
      if (threadIdx.x < half) sums[threadIdx.x] += sums[threadIdx.x + half];
    }
    if (threadIdx.x == 0) partial[6 * static_cast<int64_t>(blockIdx.x) + k] = sums[0];
    __syncthreads();
  }
}

// v_motion [6]: one thread each, in the order of the blocks.
__global__ void motion_kernel(const double* partial, int64_t blocks, double* v_motion) {
  double sum = 0;
  for (int64_t b = 0; b < blocks; ++b) sum += partial[6 * b + threadIdx.x];
  v_motion[threadIdx.x] = sum;
}

// ---- the volume ------------------------------------------------------------------------------------

template <class T>
__device__ __forceinline__ Blob<T> blob_of(const GridIn& grid, const Gaussian<T>& g) {
  return make_blob<Lanes<T>>(grid, blob_shape(grid, g), g.density);
}

template <class T>
struct AddVoxels {
  unsigned long long* sums;
  int nx;
  T density;
  __device__ void enter() {}
  __device__ void leave(T, T) {}
  __device__ void operator()(long row, int i, T, T e) {
    const int at = i + (threadIdx.x & (kLanes - 1));
    if (at < nx) add_exactly(sums + row + at, density * e);
  }
};

template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
voxelize_kernel(GridIn grid, SplatsIn<T> splats, unsigned long long* sums) {
  const int64_t n = thread_index() / kLanes;
  if (n >= splats.count) return;
  const Blob<T> b = blob_of(grid, load_one(splats, n));
  AddVoxels<T> add{sums, grid.nx, b.density};
  walk_blob<Lanes<T>>(grid, b, 0, grid.nz, add);
}

template <class T>
struct ReadVoxels {
  const T* volume;
  int nx;
  __device__ T operator()(long row, int i) const {
    const int at = i + (threadIdx.x & (kLanes - 1));
    return at < nx ? volume[row + at] : T(0);
  }
};

// moments [count]: overwrites.
template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
gather_voxels_kernel(GridIn grid, SplatsIn<T> splats, const T* v_volume, BlobMoments<T>* moments) {
  const int64_t n = thread_index() / kLanes;
  const Blob<T> b = blob_of(grid, load_one(splats, n < splats.count ? n : splats.count - 1));
  GatherBlob<Lanes<T>, T, ReadVoxels<T>> gather{{v_volume, grid.nx}};
  walk_blob<Lanes<T>>(grid, b, 0, grid.nz, gather);
  const BlobMoments<T> m = gather.total(grid);
  if (n < splats.count && (threadIdx.x & (kLanes - 1)) == 0) moments[n] = m;
}

template <class T>
__global__ void __launch_bounds__(kThreads, kBlocks)
reverse_voxels_kernel(GridIn grid, SplatsIn<T> splats, const BlobMoments<T>* moments, SplatsOut<T> v) {
  const int64_t n = thread_index();
  if (n >= splats.count) return;
  const Gaussian<T> g = load_one(splats, n);
  const Blob<T> b = blob_of(grid, g);
  store_one(v, n, b.i0 <= b.i1 ? blob_vjp(g, moments[n]) : no_gradient<T>());
}

}  // namespace SPLAT_NS

// ---- launches --------------------------------------------------------------------------------------

template <class T>
void CudaRenderer<T>::render(const FrameIn& frame, const SplatsIn<T>& splats, T* image) {
  const int64_t pixels = static_cast<int64_t>(rows_) * cols_;
  auto* stamps = reinterpret_cast<Stamp<T>*>(stamps_.reserve(splats.count * sizeof(Stamp<T>)));
  auto* sums = sums_.reserve(pixels);
  check(cudaMemsetAsync(sums, 0, pixels * sizeof(*sums), stream_), "clear the image");
  const View<T> view = make_view<T>(frame, rows_, cols_);
  stamp_kernel<<<blocks_for(splats.count), kThreads, 0, stream_>>>(view, splats, rows_, cols_, stamps);
  forward_kernel<<<blocks_for(splats.count * kLanes), kThreads, 0, stream_>>>(stamps, splats.count, rows_, cols_, sums);
  from_units_kernel<<<blocks_for(pixels), kThreads, 0, stream_>>>(sums, pixels, image);
  check(cudaGetLastError(), "render");
}

template <class T>
void CudaRenderer<T>::render_vjp(const FrameIn& frame, const SplatsIn<T>& splats, const T* v_image,
                                 const SplatsOut<T>& v, double* v_motion) {
  const View<T> view = make_view<T>(frame, rows_, cols_);
  const unsigned blocks = blocks_for(splats.count);
  auto* stamps = reinterpret_cast<Stamp<T>*>(stamps_.reserve(splats.count * sizeof(Stamp<T>)));
  auto* moments = reinterpret_cast<Moments<T>*>(moments_.reserve(splats.count * sizeof(Moments<T>)));
  double* partial = partial_.reserve(6 * static_cast<size_t>(blocks));
  stamp_kernel<<<blocks, kThreads, 0, stream_>>>(view, splats, rows_, cols_, stamps);
  gather_kernel<<<blocks_for(splats.count * kLanes), kThreads, 0, stream_>>>(
      stamps, splats.count, rows_, cols_, v_image, moments);
  reverse_kernel<<<blocks, kThreads, 0, stream_>>>(view, splats, stamps, moments, v, partial);
  if (v_motion) motion_kernel<<<1, 6, 0, stream_>>>(partial, blocks, v_motion);
  check(cudaGetLastError(), "render_vjp");
}

template <class T>
void voxelize_cuda(const GridIn& grid, const SplatsIn<T>& splats, T* volume, cudaStream_t stream) {
  const int64_t voxels = static_cast<int64_t>(grid.nz) * grid.ny * grid.nx;
  DeviceBuffer<unsigned long long> buffer;
  auto* sums = buffer.reserve(voxels);
  check(cudaMemsetAsync(sums, 0, voxels * sizeof(*sums), stream), "clear the volume");
  voxelize_kernel<<<blocks_for(splats.count * kLanes), kThreads, 0, stream>>>(grid, splats, sums);
  from_units_kernel<<<blocks_for(voxels), kThreads, 0, stream>>>(sums, voxels, volume);
  check(cudaGetLastError(), "voxelize");
  check(cudaStreamSynchronize(stream), "voxelize");  // before its sums are freed
}

template <class T>
void voxelize_vjp_cuda(const GridIn& grid, const SplatsIn<T>& splats, const T* v_volume, const SplatsOut<T>& v,
                       cudaStream_t stream) {
  DeviceBuffer<BlobMoments<T>> buffer;
  BlobMoments<T>* moments = buffer.reserve(splats.count);
  const unsigned blocks = blocks_for(splats.count * kLanes);
  gather_voxels_kernel<<<blocks, kThreads, 0, stream>>>(grid, splats, v_volume, moments);
  reverse_voxels_kernel<<<blocks_for(splats.count), kThreads, 0, stream>>>(grid, splats, moments, v);
  check(cudaGetLastError(), "voxelize_vjp");
  check(cudaStreamSynchronize(stream), "voxelize_vjp");
}

#define SPLAT_CUDA_FOR(T)                                                                              \
  template class CudaRenderer<T>;                                                                      \
  template void voxelize_cuda<T>(const GridIn&, const SplatsIn<T>&, T*, cudaStream_t);                 \
  template void voxelize_vjp_cuda<T>(const GridIn&, const SplatsIn<T>&, const T*, const SplatsOut<T>&,   \
                                     cudaStream_t);
SPLAT_CUDA_FOR(float)
SPLAT_CUDA_FOR(double)
#undef SPLAT_CUDA_FOR

}  // namespace splat
