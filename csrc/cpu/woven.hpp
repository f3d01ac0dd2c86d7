// Woven images: as many rows as a tile of lanes is high lie interleaved, so that the pixels of a tile are one
// contiguous piece of memory. Tiles are one row high where a register holds up to eight numbers; then this is a plain
// image with a stride.
#pragma once

#include <cstring>

#include "kernels/lanes.hpp"

namespace splat {
inline namespace SPLAT_NS {

// Tile (x, y) of an image, y a multiple of its height: the pixels (x + column, y + row) of its lanes from here on.
template <class L>
SPLAT_HD long tile_at(long stride, int x, int y) { return y * stride + static_cast<long>(x) * L::height; }

// Rows y .. y + height - 1 of a plain image [rows, cols], rows `pitch` apart, into their place in a woven one. Rows
// past the end are zero.
template <class L, class T>
inline void weave(const T* plain, long pitch, int rows, int cols, int y, T* woven, long stride) {
  constexpr int h = L::height;
  T* to = woven + y * stride;
  const T* from = plain + y * pitch;
  if constexpr (h == 1) {
    memcpy(to, from, cols * sizeof(T));
  } else {
    for (int r = 0; r < h; ++r)
      for (int x = 0; x < cols; ++x) to[x * h + r] = y + r < rows ? from[r * pitch + x] : T(0);
  }
}

// Row y of a woven image as a plain one. [cols]
template <class L, class T>
inline void unweave(const T* woven, long stride, int y, int cols, T* plain) {
  constexpr int h = L::height;
  const T* from = woven + (y - y % h) * stride + y % h;
  if constexpr (h == 1) {
    memcpy(plain, from, cols * sizeof(T));
  } else {
    for (int x = 0; x < cols; ++x) plain[x] = from[x * h];
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
