// Stamp: a footprint made ready to be walked, and the walk itself: the one place that says what value
// a splat has at a pixel. Forward, gather and Gauss-Newton kernels pass their own visitor.
#pragma once

#include "kernels/lanes.hpp"
#include "math/camera.hpp"

namespace splat {
inline namespace SPLAT_NS {

// A footprint ends where dx'S^-1dx reaches this: at 4 standard deviations, 3.4e-4 of its peak.
inline constexpr double kCutoff = 16.0;

template <class T>
struct Stamp {
  T column, row, amplitude;
  T a, b, c;                // exponent in powers of two: 2^(a dx^2 + b dx dy + c dy^2)
  T slope, half_height;     // rows of the ellipse at dx: slope dx +- half_height
  T half_width;
  int x0, x1, y0, y1;       // inclusive pixel bounds inside the image; x0 > x1 where nothing shows
};

inline constexpr double kLog2E = 1.4426950408889634;

// Never NaN: a Gaussian that does not lie before the source as a whole (clearance, see Projected), outside the
// image or without mass gives an empty stamp.
template <class T>
SPLAT_HD Stamp<T> make_stamp(const Footprint<T>& f, T clearance, int rows, int cols) {
  Stamp<T> s;
  s.column = f.column;
  s.row = f.row;
  s.amplitude = f.amplitude;
  s.x0 = 0;
  s.x1 = -1;
  s.y0 = 0;
  s.y1 = -1;
  const T det = f.a * f.c - f.b * f.b;
  const bool finite =
      clearance > T(0) && f.amplitude != T(0) && det > T(0) && (f.amplitude + f.column + f.row) * T(0) == T(0);
  if (!finite) return s;
  const T scale(-0.5 * kLog2E);
  s.a = scale * f.a;
  s.b = T(2) * scale * f.b;
  s.c = scale * f.c;
  s.slope = -f.b / f.c;
  const T reach = sqrt_of(T(kCutoff));
  s.half_height = reach / sqrt_of(f.c);
  s.half_width = reach * sqrt_of(f.c / det);
  const T tall = reach * sqrt_of(f.a / det);
  const T last_x(cols - 1), last_y(rows - 1);
  const T left = max_of(s.column - s.half_width, T(0)), right = min_of(s.column + s.half_width, last_x);
  const T top = max_of(s.row - tall, T(0)), bottom = min_of(s.row + tall, last_y);
  if (!(left <= right && top <= bottom)) return s;
  s.x0 = static_cast<int>(ceil(left));
  s.x1 = static_cast<int>(floor(right));
  s.y0 = static_cast<int>(ceil(top));
  s.y1 = static_cast<int>(floor(bottom));
  if (s.x0 > s.x1 || s.y0 > s.y1) s.x1 = s.x0 - 1;
  return s;
}

// Calls visit(x, y, dx, dy, e) for every `width` pixels (x + lane, y) of the stamp in rows [row_begin, row_end): e is
// the unit-amplitude value, zero beyond the cutoff. It goes down columns: visit.enter(dx) comes before the rows of
// a group of columns and visit.leave(dx) after them, so that what depends on dx alone is done once.
template <class L, class T, class Visit>
SPLAT_HD void walk(const Stamp<T>& s, int row_begin, int row_end, Visit& visit) {
  using V = typename L::Value;
  const V zero(T(0)), limit(T(-0.5 * kLog2E * kCutoff));
  for (int x = s.x0; x <= s.x1; x += L::width) {
    const T left = max_of(T(x) - s.column, -s.half_width);
    const T right = min_of(T(x + L::width - 1) - s.column, s.half_width);
    const T at_left = s.slope * left, at_right = s.slope * right;
    int y = static_cast<int>(ceil(max_of(s.row + min_of(at_left, at_right) - s.half_height, T(s.y0))));
    int last = static_cast<int>(floor(min_of(s.row + max_of(at_left, at_right) + s.half_height, T(s.y1))));
    y = y > row_begin ? y : row_begin;
    last = last < row_end - 1 ? last : row_end - 1;
    const V dx = L::index() + V(T(x) - s.column);
    const V along = V(s.a) * dx * dx, mixed = V(s.b) * dx;
    if (y > last) continue;
    visit.enter(dx);
    for (; y <= last; ++y) {
      const T dy = T(y) - s.row;
      const V power = along + V(dy) * (mixed + V(s.c * dy));
      const V e = select(power > limit, exp2_of(power), zero);
      visit(x, y, dx, dy, e);
    }
    visit.leave(dx);
  }
}

// Sums a gradient image over a footprint into the six moments.
template <class L, class T, class Read>
struct GatherMoments {
  using V = typename L::Value;
  Read read;  // read(x, y): the gradient at pixels x + lane of row y, zero outside the image
  V one{T(0)}, x{T(0)}, xx{T(0)}, y{T(0)}, xy{T(0)}, yy{T(0)};
  V g0{T(0)}, g1{T(0)}, g2{T(0)};  // of the present columns: sums of G e times 1, dy, dy^2
  SPLAT_HD void enter(V) { g0 = g1 = g2 = V(T(0)); }
  SPLAT_HD void operator()(int px, int py, V, T dy, V e) {
    const V g = read(px, py) * e, gy = g * V(dy);
    g0 += g;
    g1 += gy;
    g2 += gy * V(dy);
  }
  SPLAT_HD void leave(V dx) {
    const V gx = g0 * dx;
    one += g0;
    x += gx;
    xx += gx * dx;
    y += g1;
    xy += g1 * dx;
    yy += g2;
  }
  SPLAT_HD Moments<T> total() const {
    return {L::sum(one), L::sum(x), L::sum(y), L::sum(xx), L::sum(xy), L::sum(yy)};
  }
};

}  // namespace SPLAT_NS
}  // namespace splat
