// Chooses among the functions that were compiled for several processors.
#pragma once

#if defined(__x86_64__)
// One of `name`_baseline, `name`_avx2 and `name`_avx512: the newest that this processor runs.
#define OF_THIS_PROCESSOR(name)                                                                 \
  (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&                   \
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw")             \
       ? name##_avx512                                                                          \
       : (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? name##_avx2 : name##_baseline))
#else
#define OF_THIS_PROCESSOR(name) name##_baseline
#endif
