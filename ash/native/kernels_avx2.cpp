#define ASH_ISA avx2
#define ASH_KERNELS avx2_kernels
#include "kernels.inc"
