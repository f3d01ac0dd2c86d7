// CUDA errors as exceptions, and memory that frees itself.
#pragma once

#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

namespace splat {

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(status));
}

// A growing array on the device, freed when the stream that uses it has been waited for.
template <class T>
class DeviceBuffer {
 public:
  DeviceBuffer() = default;
  DeviceBuffer(const DeviceBuffer&) = delete;
  DeviceBuffer& operator=(const DeviceBuffer&) = delete;
  ~DeviceBuffer() { cudaFree(data_); }
  // Room for n; contents are lost when it grows.
  T* reserve(size_t n) {
    if (n > capacity_) {
      check(cudaFree(data_), "free device memory");
      data_ = nullptr, capacity_ = 0;
      check(cudaMalloc(&data_, n * sizeof(T)), "reserve device memory");
      capacity_ = n;
    }
    return data_;
  }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace splat
