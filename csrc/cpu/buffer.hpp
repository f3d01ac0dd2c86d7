// An aligned, growing array. Not std::vector: code compiled for AVX-512 must not leave symbols that the
// linker could hand to a caller on an older processor, and every std:: template instantiated here would.
#pragma once

#include <cstdlib>
#include <cstring>

#include "platform.hpp"

namespace splat {
inline namespace SPLAT_NS {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { free(data_); }
  // Room for n; contents are lost when it grows.
  T* reserve(size_t n) {
    if (n > capacity_) {
      free(data_);
      capacity_ = n + n / 4 + 64;
      data_ = static_cast<T*>(aligned_alloc(64, (capacity_ * sizeof(T) + 63) / 64 * 64));
      if (!data_) abort();
    }
    return data_;
  }
  T* data() { return data_; }
  T& operator[](size_t i) { return data_[i]; }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace SPLAT_NS
}  // namespace splat
