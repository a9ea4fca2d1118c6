#define ASH_ISA avx512
#include "kernels.inc"

namespace ash {
const Kernels avx512_kernels = {"avx512", avx512::project, avx512::project_backward, avx512::prepare, avx512::blend, avx512::blend_backward,
                               avx512::gather, avx512::ssim_rows, avx512::ssim_scratch, avx512::fma_work,
                               avx512::place_texels, avx512::pose, avx512::pose_backward, avx512::adam, avx512::shade, avx512::shade_backward,
                               avx512::multiply, avx512::pack, avx512::raster_band};
}
