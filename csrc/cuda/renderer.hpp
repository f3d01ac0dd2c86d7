// The core on a CUDA device. As in api.hpp, but pointers are the device's and work is queued on a stream.
#pragma once

#include <cuda_runtime.h>

#include "api.hpp"
#include "cuda/check.hpp"

namespace splat {

// Draws splats onto one detector size. Scratch memory belongs to the object: one stream at a time.
template <class T>
class CudaRenderer {
 public:
  CudaRenderer(int rows, int cols, cudaStream_t stream) : rows_(rows), cols_(cols), stream_(stream) {}
  // image [rows, cols]: overwrites. The same bits every time.
  void render(const FrameIn&, const SplatsIn<T>&, T* image);
  // Reverse of render for dL/dimage = v_image. Overwrites v and v_motion [6] (omega, tau), which may be null.
  void render_vjp(const FrameIn&, const SplatsIn<T>&, const T* v_image, const SplatsOut<T>& v, double* v_motion);

 private:
  const int rows_, cols_;
  const cudaStream_t stream_;
  DeviceBuffer<unsigned char> stamps_, moments_;  // of types that differ with the instruction set
  DeviceBuffer<unsigned long long> sums_;
  DeviceBuffer<double> partial_;
};

// volume [nz, ny, nx]: overwrites with the density at voxel centres. The same bits every time.
template <class T>
void voxelize_cuda(const GridIn&, const SplatsIn<T>&, T* volume, cudaStream_t stream);
template <class T>
void voxelize_vjp_cuda(const GridIn&, const SplatsIn<T>&, const T* v_volume, const SplatsOut<T>& v,
                       cudaStream_t stream);

}  // namespace splat
