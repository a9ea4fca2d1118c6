#define ASH_ISA avx2
#include "kernels.inc"

namespace ash {
const Kernels avx2_kernels = {"avx2", avx2::project, avx2::project_backward, avx2::prepare, avx2::blend, avx2::blend_backward,
                               avx2::gather, avx2::ssim_rows, avx2::ssim_scratch, avx2::fma_work,
                               avx2::place_texels, avx2::pose, avx2::pose_backward, avx2::adam, avx2::shade, avx2::shade_backward,
                               avx2::multiply, avx2::pack, avx2::raster_band};
}
