// Splats onto a voxel grid and back: the density at voxel centres, and its reverse.
//
// Forward is parallel over slabs of z slices, reverse over chunks of splats, as in cpu/renderer.hpp.
#pragma once

#include "cpu/buffer.hpp"
#include "cpu/load.hpp"
#include "kernels/blob.hpp"

namespace splat {
inline namespace SPLAT_NS {

inline constexpr int kSlab = 8;  // slices a slab

// Blobs are about eight voxels wide: more lanes would idle.
template <class T>
using BlobLanes = PackLanes<T, (kLanesOf<T> < 8 ? kLanesOf<T> : 8)>;

// Blobs of splats first .. first + n - 1, n <= P::size.
template <class P, class T>
SPLAT_HD void make_blobs(const GridIn& grid, const Gaussian<P>& g, int n, Blob<T>* out) {
  const BlobShape<P> s = blob_shape(grid, g);
  for (int l = 0; l < n; ++l) {
    const BlobShape<T> one{s.i.v[l],  s.j.v[l],  s.k.v[l],  s.ii.v[l],      s.jj.v[l],      s.kk.v[l],
                           s.ij.v[l], s.ik.v[l], s.jk.v[l], s.reach_i.v[l], s.reach_j.v[l], s.reach_k.v[l]};
    out[l] = make_blob<BlobLanes<T>>(grid, one, g.density.v[l]);
  }
}

template <class T>
struct AddBlob {
  using V = typename BlobLanes<T>::Value;
  T* volume;
  int nx;
  V density;
  SPLAT_HD void enter() {}
  SPLAT_HD void leave(V, T) {}
  SPLAT_HD void operator()(long row, int i, T, V e) {
    const V value = density * e;
    T* at = volume + row + i;
    if (i + V::size <= nx) return (V::load(at) + value).store(at);
    for (int lane = 0; i + lane < nx; ++lane) at[lane] += value.v[lane];
  }
};

template <class T>
void voxelize(const GridIn& grid, const SplatsIn<T>& splats, T* volume, int threads) {
  using P = typename PackLanes<T>::Value;   // splats
  using V = typename BlobLanes<T>::Value;  // voxels
  const int slabs = (grid.nz + kSlab - 1) / kSlab;
  Buffer<Blob<T>> all;
  Blob<T>* blobs = all.reserve(splats.count);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t first = 0; first < splats.count; first += P::size) {
    const int64_t n = splats.count - first < P::size ? splats.count - first : P::size;
    make_blobs(grid, load_pack<P>(splats, first), static_cast<int>(n), blobs + first);
  }
  // Counting sort into slabs, in index order.
  Buffer<int64_t> starts;
  Buffer<int32_t> orders;
  int64_t* start = starts.reserve(2 * slabs + 1);
  int64_t* next = start + slabs + 1;
  for (int s = 0; s <= slabs; ++s) start[s] = 0;
  for (int64_t n = 0; n < splats.count; ++n)
    if (blobs[n].i0 <= blobs[n].i1)
      for (int s = blobs[n].k0 / kSlab; s <= blobs[n].k1 / kSlab; ++s) ++start[s + 1];
  for (int s = 0; s < slabs; ++s) start[s + 1] += start[s];
  int32_t* order = orders.reserve(start[slabs]);
  for (int s = 0; s < slabs; ++s) next[s] = start[s];
  for (int64_t n = 0; n < splats.count; ++n)
    if (blobs[n].i0 <= blobs[n].i1)
      for (int s = blobs[n].k0 / kSlab; s <= blobs[n].k1 / kSlab; ++s) order[next[s]++] = static_cast<int32_t>(n);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int s = 0; s < slabs; ++s) {
    const int from = s * kSlab, to = from + kSlab < grid.nz ? from + kSlab : grid.nz;
    const long slice = static_cast<long>(grid.ny) * grid.nx;
    memset(volume + from * slice, 0, static_cast<size_t>(to - from) * slice * sizeof(T));
    for (int64_t n = start[s]; n < start[s + 1]; ++n) {
      const Blob<T>& b = blobs[order[n]];
      AddBlob<T> add{volume, grid.nx, V(b.density)};
      walk_blob<BlobLanes<T>>(grid, b, from, to, add);
    }
  }
}

template <class T>
void voxelize_vjp(const GridIn& grid, const SplatsIn<T>& splats, const T* v_volume, const SplatsOut<T>& v,
                  int threads) {
  using P = typename PackLanes<T>::Value;   // splats
  using V = typename BlobLanes<T>::Value;  // voxels
  auto read = [=, &grid](long row, int i) {
    if (i + V::size <= grid.nx) return V::load(v_volume + row + i);
    V tail(T(0));
    for (int lane = 0; i + lane < grid.nx; ++lane) tail.v[lane] = v_volume[row + i + lane];
    return tail;
  };
#pragma omp parallel for num_threads(threads) schedule(dynamic, 64)
  for (int64_t first = 0; first < splats.count; first += P::size) {
    const int n = splats.count - first < P::size ? static_cast<int>(splats.count - first) : P::size;
    const Gaussian<P> g = load_pack<P>(splats, first);
    Blob<T> blob[P::size];
    make_blobs(grid, g, n, blob);
    const P zero(T(0));
    BlobMoments<P> m{zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
    for (int l = 0; l < n; ++l) {
      GatherBlob<BlobLanes<T>, T, decltype(read)> gather{read};
      walk_blob<BlobLanes<T>>(grid, blob[l], 0, grid.nz, gather);
      const BlobMoments<T> t = gather.total(grid);
      m.one.v[l] = t.one, m.x.v[l] = t.x, m.y.v[l] = t.y, m.z.v[l] = t.z, m.xx.v[l] = t.xx;
      m.yy.v[l] = t.yy, m.zz.v[l] = t.zz, m.xy.v[l] = t.xy, m.xz.v[l] = t.xz, m.yz.v[l] = t.yz;
    }
    P shown(T(0));
    for (int l = 0; l < n; ++l) shown.v[l] = blob[l].i0 <= blob[l].i1;
    store_pack<P>(v, first, n, blob_vjp(g, m), shown > zero);
  }
}

}  // namespace SPLAT_NS
}  // namespace splat
