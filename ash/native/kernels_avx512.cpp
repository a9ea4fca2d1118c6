#define ASH_ISA avx512
#define ASH_KERNELS avx512_kernels
#include "kernels.inc"
