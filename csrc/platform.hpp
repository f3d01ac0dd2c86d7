// The only file that asks which compiler reads it.
//
// SPLAT_HD marks what runs on host and device. SPLAT_NS names the instruction set a translation
// unit is compiled for: the same template compiled for AVX-512 and for plain x86-64 would otherwise
// give one symbol that the linker merges, and an illegal instruction on the older machine.
#pragma once

#if defined(__CUDACC__)
#define SPLAT_HD __host__ __device__ __forceinline__
#else
#define SPLAT_HD inline __attribute__((always_inline))
#endif

#ifndef SPLAT_NS
#error "SPLAT_NS must name the instruction set of this translation unit (see CMakeLists.txt)"
#endif
