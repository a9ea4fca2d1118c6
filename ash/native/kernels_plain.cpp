#define ASH_ISA plain
#define ASH_KERNELS plain_kernels
#include "kernels.inc"
