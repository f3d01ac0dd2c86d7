// Stamp: a footprint made ready to be walked, and the walk itself: the one place that says what value
// a splat has at a pixel. Forward, gather and Gauss-Newton kernels pass their own visitor.
#pragma once

#include "kernels/lanes.hpp"
#include "math/camera.hpp"

namespace splat {
inline namespace SPLAT_NS {

// A footprint ends where dx'S^-1dx reaches this: at 4 standard deviations, 3.4e-4 of its peak.
inline constexpr double kCutoff = 16.0;
inline constexpr double kCutoffValue = 3.3546262790251185e-4;  // exp(-kCutoff / 2)

inline constexpr double kLog2E = 1.4426950408889634;

// Values of a column come from the one above by multiplications (see walk), and every so often afresh.
inline constexpr int kRun = 8;          // tiles at most from one exponential to the next: errors grow with the square
inline constexpr double kFloor = -120;  // exponents below are raised to it: 2^-120 is still a normal float

// All fields are of one size, so that packs of stamps transpose into records: 64 bytes with floats, a line of cache.
template <class T>
struct Stamp {
  using Whole = typename WholeOf<T>::Type;
  T column, row, amplitude;
  T a, b, c;             // exponent in powers of two: 2^(a dx^2 + b dx dy + c dy^2)
  T bend;                // 2^(2 c h^2), h the height of a tile: the second ratio of values h rows apart
  T slope, half_height;  // rows of the ellipse at dx: slope dx +- half_height
  T half_width;
  Whole run;             // tiles from one exponential to the next, 1 .. kRun
  Whole x0, x1, y0, y1;  // inclusive pixel bounds inside the image; x0 > x1 where nothing shows
  T unused;
};
inline constexpr int kStampFields = 16;

template <class T>
SPLAT_HD bool shows(const Stamp<T>& s) { return s.x0 <= s.x1; }

// L: the lanes that will walk it. T: a number, or a pack of them to make several stamps.
// Never NaN where it shows: a Gaussian that does not lie before the source as a whole (clearance, see Projected),
// outside the image or without mass gives an empty stamp.
template <class L, class T>
SPLAT_HD Stamp<T> make_stamp(const Footprint<T>& f, T clearance, int rows, int cols) {
  using N = typename L::Scalar;
  const T zero(N(0)), one(N(1)), reach(sqrt_of(N(kCutoff))), scale(N(-0.5 * kLog2E)), h(N(L::height));
  Stamp<T> s;
  s.column = f.column;
  s.row = f.row;
  s.amplitude = f.amplitude;
  s.a = scale * f.a;
  s.b = (scale + scale) * f.b;
  s.c = scale * f.c;
  s.bend = exp2_of(max_of((h * h + h * h) * s.c, T(N(kFloor))));
  const T det = f.a * f.c - f.b * f.b, of_c = one / f.c, of_det = one / det;
  s.slope = -f.b * of_c;
  s.half_height = reach * sqrt_of(of_c);
  s.half_width = reach * sqrt_of(f.c * of_det);
  const T tall = reach * sqrt_of(f.a * of_det);
  // A value raised to the floor must not grow past the cutoff, 2^-11.5, within a run: `growth` bounds the exponent's
  // rise from one tile to the next, over all lanes that walk takes along.
  const T size_b = max_of(s.b, -s.b), beyond(N(L::width));
  const T growth = h * (size_b * (s.half_width + beyond) - (s.c + s.c) * (tall + h));
  s.run = whole_of(min_of(one + T(N(-kFloor - 12)) / growth, T(N(kRun))));
  const T last_x(N(cols - 1)), last_y(N(rows - 1));
  const T left = ceil_of<N>(max_of(s.column - s.half_width, zero));
  const T right = floor_of<N>(min_of(s.column + s.half_width, last_x));
  const T top = ceil_of<N>(max_of(s.row - tall, zero)), bottom = floor_of<N>(min_of(s.row + tall, last_y));
  const auto shown = (clearance > zero) & (f.amplitude != zero) & (det > zero) & (left <= right) & (top <= bottom) &
                     ((f.amplitude + f.column + f.row) * zero == zero);
  s.x0 = whole_of(select(shown, left, zero)), s.x1 = whole_of(select(shown, right, -one));
  s.y0 = whole_of(select(shown, top, zero)), s.y1 = whole_of(select(shown, bottom, -one));
  s.unused = zero;
  return s;
}

// Calls visit(x, y, dx, dy, e) for every tile of pixels (x + lane's column, y + lane's row) of the stamp in rows
// [row_begin, row_end): e is the unit-amplitude value, zero beyond the cutoff. It goes down columns: visit.enter(dx)
// comes before the tiles of a group of columns and visit.leave(dx) after them, so that what depends on dx alone is
// done once. Tiles start at rows that are multiples of their height, as row_begin is; their last rows may lie beyond
// row_end or the image.
//
// With p(dy) the exponent at dx, p(dy + h) - p(dy) = h (b dx + c (2 dy + h)) is linear in dy. So values down a column
// are products: value *= ratio, ratio *= bend. An exponential is due only at the head of a run.
template <class L, class T, class Visit>
SPLAT_HD void walk(const Stamp<T>& s, int row_begin, int row_end, Visit& visit) {
  using V = typename L::Value;
  constexpr int h = L::height;
  const V zero(T(0)), cutoff{T(kCutoffValue)}, lowest{T(kFloor)}, step{T(h)};
  const int x0 = static_cast<int>(s.x0), x1 = static_cast<int>(s.x1), run = static_cast<int>(s.run);
  const int top = static_cast<int>(s.y0), bottom = static_cast<int>(s.y1);
  const int begin = top > row_begin ? top : row_begin, end = bottom < row_end - 1 ? bottom : row_end - 1;
  for (int x = x0; x <= x1; x += L::width) {
    int y = begin, last = end;
    if (x1 - x0 >= 2 * L::width) {  // many groups of columns: the rows of this one; else the branches cost more
      const T left = max_of(T(x) - s.column, -s.half_width);
      const T right = min_of(T(x + L::width - 1) - s.column, s.half_width);
      const T at_left = s.slope * left, at_right = s.slope * right;
      const T upper = max_of(s.row + min_of(at_left, at_right) - s.half_height, T(begin));
      const T lower = min_of(s.row + max_of(at_left, at_right) + s.half_height, T(end));
      if (!(upper <= lower)) continue;
      y = static_cast<int>(ceil_of<T>(upper));
      last = static_cast<int>(floor_of<T>(lower));
    }
    if (y > last) continue;
    y -= y % h;
    const V dx = L::column() + V(T(x) - s.column);
    const V along = V(s.a) * dx * dx, mixed = V(s.b) * dx, c(s.c), bend(s.bend);
    V dy = L::row() + V(T(y) - s.row);
    visit.enter(dx);
    while (y <= last) {
      V value = exp2_of(max_of(along + dy * (mixed + c * dy), lowest));
      V ratio = exp2_of(max_of(step * (mixed + c * (dy + dy + step)), lowest));
      const int stop = last < y + (run - 1) * h ? last : y + (run - 1) * h;
      for (;;) {
        visit(x, y, dx, dy, select(value > cutoff, value, zero));
        y += h;
        dy += step;
        if (y > stop) break;
        value *= ratio;
        ratio *= bend;
      }
    }
    visit.leave(dx);
  }
}

// Sums of G e times 1, dx, dy, dx^2, dx dy, dy^2 over a footprint, each lane its own share; G = dL/dimage.
template <class L, class T, class Read>
struct GatherMoments {
  using V = typename L::Value;
  Read read;  // read(x, y): the gradient at the pixels of tile (x, y), zero outside the image
  V one{T(0)}, x{T(0)}, xx{T(0)}, y{T(0)}, xy{T(0)}, yy{T(0)};
  V g0{T(0)}, g1{T(0)}, g2{T(0)};  // of the present columns: sums of G e times 1, dy, dy^2
  SPLAT_HD void enter(V) { g0 = g1 = g2 = V(T(0)); }
  SPLAT_HD void operator()(int px, int py, V, V dy, V e) {
    const V g = read(px, py) * e, gy = g * dy;
    g0 += g;
    g1 += gy;
    g2 += gy * dy;
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
};

}  // namespace SPLAT_NS
}  // namespace splat
