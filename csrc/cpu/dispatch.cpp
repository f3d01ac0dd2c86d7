// Which instruction set to run: the best this processor has, or the one asked for.
#include <cstring>

#include "api.hpp"

namespace splat {

#define SPLAT_DECLARE(isa)             \
  namespace isa {                      \
  const Core<float>& core_float();     \
  const Core<double>& core_double();   \
  }
SPLAT_DECLARE(plain)
#ifdef SPLAT_X86
SPLAT_DECLARE(avx2)
SPLAT_DECLARE(avx512)
#endif
#undef SPLAT_DECLARE

namespace {

struct Isa {
  const char* name;
  bool (*supported)();
  const Core<float>& (*of_float)();
  const Core<double>& (*of_double)();
};

const Isa kIsas[] = {
#ifdef SPLAT_X86
    {"avx512",
     [] {
       return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
              __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("fma");
     },
     avx512::core_float, avx512::core_double},
    {"avx2", [] { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"); }, avx2::core_float,
     avx2::core_double},
#endif
    {"plain", [] { return true; }, plain::core_float, plain::core_double},
};

const Isa* chosen = nullptr;

}  // namespace

const char* choose_isa(const char* name) {
  for (const Isa& isa : kIsas) {
    if ((!name || std::strcmp(name, isa.name) == 0) && isa.supported()) {
      chosen = &isa;
      return isa.name;
    }
  }
  return nullptr;
}

template <>
const Core<float>& core<float>() {
  if (!chosen) choose_isa(nullptr);
  return chosen->of_float();
}

template <>
const Core<double>& core<double>() {
  if (!chosen) choose_isa(nullptr);
  return chosen->of_double();
}

}  // namespace splat
