#define ASH_ISA plain
#include "kernels.inc"

namespace ash {
const Kernels plain_kernels = {"plain", plain::project, plain::project_backward, plain::prepare, plain::blend, plain::blend_backward,
                               plain::gather, plain::ssim_rows, plain::ssim_scratch, plain::fma_work,
                               plain::place_texels, plain::pose, plain::pose_backward, plain::adam, plain::shade, plain::shade_backward,
                               plain::multiply, plain::pack, plain::raster_band};
}
