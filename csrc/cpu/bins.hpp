// Which splats show in which band of detector rows: a stable counting sort, parallel over pieces of splats.
#pragma once

#include "cpu/buffer.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kBand = 32;    // rows a band; a multiple of every tile's height
inline constexpr int kBlock = 32;   // columns a block
inline constexpr int kPiece = 2048; // splats a piece: never depends on the number of threads

// Where one splat shows: bands first .. last (first > last: nowhere), and the block of its leftmost column.
struct Place {
  int16_t first, last, block;
};

class Bins {
 public:
  // To be filled before `sort`. [count]
  Place* places(int64_t count) { return places_.reserve(count); }

  // Splats in bands, each in as many bands as it shows in; in a band by block, in a block by index. With blocks = 1
  // the bands are in index order.
  void sort(int64_t count, int bands, int blocks, int threads) {
    const Place* places = places_.data();
    const int64_t pieces = (count + kPiece - 1) / kPiece, buckets = static_cast<int64_t>(bands) * blocks;
    int32_t* next = next_.reserve(pieces * buckets);
    int64_t* start = start_.reserve(bands + 1);
    auto each = [=](int64_t piece, auto body) {
      const int64_t end = (piece + 1) * kPiece < count ? (piece + 1) * kPiece : count;
      for (int64_t n = piece * kPiece; n < end; ++n) {
        const int block = blocks > 1 ? places[n].block : 0;
        for (int band = places[n].first; band <= places[n].last; ++band) body(n, band * blocks + block);
      }
    };
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int64_t piece = 0; piece < pieces; ++piece) {
      int32_t* tally = next + piece * buckets;
      memset(tally, 0, buckets * sizeof(int32_t));
      each(piece, [=](int64_t, int64_t bucket) { ++tally[bucket]; });
    }
    // Where each piece's share of each bucket begins.
    int32_t total = 0;
    for (int64_t bucket = 0; bucket < buckets; ++bucket) {
      if (bucket % blocks == 0) start[bucket / blocks] = total;
      for (int64_t piece = 0; piece < pieces; ++piece) {
        const int32_t here = next[piece * buckets + bucket];
        next[piece * buckets + bucket] = total;
        total += here;
      }
    }
    start[bands] = total;
    int32_t* order = order_.reserve(total);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int64_t piece = 0; piece < pieces; ++piece) {
      int32_t* to = next + piece * buckets;
      each(piece, [=](int64_t n, int64_t bucket) { order[to[bucket]++] = static_cast<int32_t>(n); });
    }
  }

  // The splats of a band: order() from begin(band) up to begin(band + 1).
  int64_t begin(int band) { return start_[band]; }
  const int32_t* order() { return order_.data(); }

 private:
  Buffer<Place> places_;
  Buffer<int32_t> next_, order_;
  Buffer<int64_t> start_;
};

}  // namespace SPLAT_NS
}  // namespace splat
